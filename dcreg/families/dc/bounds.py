"""Bounds over feature spaces: difference-of-convex (DC) and interval bounds, shared vertex values.

The DC bound of a box M with linearisation point theta0 is

    LB(M; theta0) = min_{v in V(M)} min_P sum p_ij [ E_ij(v) - R_i(v - theta0) ].

The costs E_ij(v) do not depend on the box, and R_i changes whole rows of costs only. Values at a vertex
can therefore be shared: they are computed once and used for every box that has the vertex and for every
theta0. `SharedVertexBound` keeps them; the families derive their bounds from it. Sharing was derived in
this project and is not in the paper.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np

from dcreg.families.dc.kernels import (
    Lattice,
    Vertices,
    dc_bound,
    find_or_add,
    interval_bound,
    rebuild,
)
from dcreg.families.dc.space import F, FeatureSpace
from dcreg.families.protocol import SpaceBound
from dcreg.search import Box, Boxes, Evaluation

# Beyond this size the cache drops the half of its vertices that was used least recently: bounds stay
# valid, some vertices are solved twice.
MAX_CACHE_BYTES = 400 * 2**20
_INITIAL_CAPACITY = 4096  # vertices


class DCBound(SpaceBound[FeatureSpace]):
    """The paper's bound: tangent of the convex part at the box centre, minimised over all 2^d vertices.

    E_ij is a difference of convex functions. Replacing its convex part by the tangent at the centre
    theta0 leaves

        LB(M) = min_{v in V(M)} min_P sum p_ij [ E_ij(v) - R_i(v - theta0) ],

    because the linearisation gap of the tangent is exactly R_i = |J_i delta|^2 and a concave function is
    minimal at a vertex. It takes one k-assignment per vertex; its gap is of second order in the box
    width.
    """

    name = "dc"
    space_type = FeatureSpace

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        found = Evaluation.empty(boxes)
        self.map_slices(
            len(boxes),
            lambda part: dc_bound(
                self.space.clouds, boxes.lower[part], boxes.upper[part], found.lower_bounds[part],
                found.thetas[part], found.values[part],
            ),
        )  # fmt: skip
        return found


class IntervalBound(SpaceBound[FeatureSpace]):
    """``min_P sum p_ij d(feature interval of x_i over the box, y_j)^2``; never negative.

    Interval arithmetic on each feature, as in Go-ICP and GoTS but one-to-one. The bound is of first order
    in the box width. On large boxes it is nevertheless stronger than the DC bound, which is very negative
    there. Its candidate is the box centre.
    """

    name = "interval"
    space_type = FeatureSpace

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        space, found = self.space, Evaluation.empty(boxes)

        def work(part: slice) -> int:
            box, bounds = boxes[part], found.lower_bounds[part]
            spent = interval_bound(space.clouds, box.lower, box.upper, bounds)
            return spent + space.objectives(found.thetas[part], found.values[part])

        self.map_slices(len(boxes), work)
        return found


class SharedVertexBound(SpaceBound[F]):
    """Base of the bounds over shared vertex values.

    Parameters
    ----------
    space, roots, threads
        As in `SpaceBound`.
    profile_size, duals_size : int
        Entries of the profile and of the dual vector kept per vertex; 0 if none is needed.

    Attributes
    ----------
    moves : int
        Maximum number of moves of the linearisation point from the box centre.
    """

    moves = 0

    def __init__(
        self,
        space: F,
        roots: Sequence[Box] | None = None,
        threads: int = 1,
        profile_size: int = 0,
        duals_size: int = 0,
    ) -> None:
        super().__init__(space, roots, threads)
        self.cache = self.stored = VertexCache(self.roots, profile_size, duals_size)

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        slots, first_new = self.cache.find(boxes.lower, boxes.upper)
        bounds = self._bound_boxes(boxes, slots, first_new, cutoff)
        best = np.where(slots >= 0, self.cache.values[slots], np.inf).argmin(axis=1)
        best = slots[np.arange(len(slots)), best]
        return Evaluation(bounds, self.cache.thetas[best], self.cache.values[best])

    @abc.abstractmethod
    def _bound_boxes(
        self, boxes: Boxes, slots: np.ndarray, first_new: int, cutoff: float | None
    ) -> np.ndarray:
        """Return the bounds of B boxes with the vertices in `slots`; those from `first_new` are new."""


class VertexCache:
    """Values at the vertices of all boxes so far, by slot; a lattice over the roots locates them.

    Its arrays are those of `Lattice` and `Vertices`.

    Parameters
    ----------
    roots : sequence of Box
        Every box is made from one of them by bisection.
    profile_size, duals_size : int
        Entries of a profile and of a dual vector; 0 if none is needed.
    """

    _ARRAYS = ("keys", "thetas", "lows", "values", "levels", "profiles", "duals", "met")

    def __init__(self, roots: Sequence[Box], profile_size: int, duals_size: int) -> None:
        self.origin = np.min([root.lower for root in roots], axis=0)
        self.width = np.max([root.upper for root in roots], axis=0) - self.origin
        self.max_vertices = MAX_CACHE_BYTES // (8 * (profile_size + duals_size + 16))
        self.used = self._calls = 0
        capacity = _INITIAL_CAPACITY
        self.keys = np.empty((capacity, 4), np.int64)
        self.met = np.empty(capacity, np.int64)  # the last call that used the vertex
        self.thetas = np.empty((capacity, self.origin.size))
        self.lows, self.values, self.levels = (np.empty(capacity) for _ in range(3))
        self.profiles, self.duals = (
            np.empty((capacity, size)) for size in (profile_size, duals_size)
        )
        self.table = np.full(4 * capacity, -1, np.int64)

    @property
    def vertices(self) -> Vertices:
        """The arrays as kernels take them; invalid after the next `find`, which may reallocate them."""
        return Vertices(self.thetas, self.lows, self.values, self.levels, self.profiles, self.duals)

    def state(self) -> dict[str, Any]:
        """Return the vertices; see `dcreg.search.Stored`."""
        arrays = {name: getattr(self, name)[: self.used] for name in self._ARRAYS}
        return {"calls": self._calls, **arrays}

    def restore(self, state: dict[str, Any]) -> None:
        """Replace the vertices by saved ones."""
        self._calls, self.used = state["calls"], 0
        self._reserve(len(state["keys"]))
        self.used = len(state["keys"])
        for name in self._ARRAYS:
            getattr(self, name)[: self.used] = state[name]
        rebuild(self.table, self.keys, self.used)

    def _reserve(self, count: int) -> None:
        if self.used + count > self.max_vertices:
            self._forget()
        needed = self.used + count
        if needed > len(self.keys):
            # allocate the maximum at once: pages never written take no memory, a second copy takes time
            for name in self._ARRAYS:
                old = getattr(self, name)
                new = np.empty((max(needed, self.max_vertices), *old.shape[1:]), old.dtype)
                new[: self.used] = old[: self.used]
                setattr(self, name, new)
        if 2 * needed > len(self.table):
            self.table = np.empty(8 * 2 ** int(needed).bit_length(), np.int64)
            rebuild(self.table, self.keys, self.used)

    def _forget(self) -> None:
        """Keep the half of the vertices that was used most recently."""
        keep = np.sort(np.argsort(self.met[: self.used], kind="stable")[self.used // 2 :])
        for name in self._ARRAYS:
            array = getattr(self, name)
            array[: keep.size] = array[keep]
        self.used = keep.size
        rebuild(self.table, self.keys, self.used)

    def find(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the slots of the boxes' vertices (-1 beyond the last), and the first new slot."""
        slots = np.full((len(lower), 2**self.origin.size), -1, np.int64)
        self._reserve(slots.size)
        self._calls += 1
        first_new = self.used
        lattice = Lattice(self.table, self.keys, self.thetas, self.met, self.origin, self.width)
        self.used = find_or_add(lattice, first_new, self._calls, lower, upper, slots)
        self.values[first_new : self.used] = np.inf
        return slots, first_new
