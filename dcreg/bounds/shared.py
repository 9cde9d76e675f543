"""DC bounds over shared vertex values: one assignment a lattice vertex instead of one a box vertex.

For any linearisation point theta0 the DC bound of a box is

    LB(M; theta0) = min_{v in V(M)} min_P sum p_ij [ E_ij(v) - R_i(v - theta0) ].

The costs E_ij(v) do not depend on the box, and R_i charges whole rows. So one exact assignment at a
vertex, kept with its dual profile r (`dcreg.kernels.shared.solve_vertices`), bounds the inner minimum for every
box that has the vertex and for every theta0: by the sum of the k smallest r_i - R_i, which is exact when
all source points match or all R_i are alike. A bisection needs its new vertices only, and theta0 may be
moved to where the bound is greatest without any assignment. Derived in this project, not in the paper.
"""

from __future__ import annotations

import numpy as np

from dcreg.bounds.base import ModelBound
from dcreg.box import Box
from dcreg.kernels import shared
from dcreg.models import Model
from dcreg.search import Evaluation

# A cache beyond this is emptied and fills again: bounds stay valid, some vertices are solved twice.
MAX_CACHE_BYTES = 400 * 2**20


class VertexCache:
    """E and dual profile at the vertices met so far, by their place on the start box's lattice.

    Parameters
    ----------
    start : Box
        Every box asked for is made from it by bisection.
    profile_size : int
        Entries of a dual profile; 0 where none is needed.
    """

    def __init__(self, start: Box, profile_size: int) -> None:
        self.origin, self.width = start.lower, start.upper - start.lower
        self.profile_size = profile_size
        self.max_vertices = MAX_CACHE_BYTES // (8 * (profile_size + 14))
        self._empty()

    def _empty(self, capacity: int = 1024) -> None:
        self.used = 0
        self.keys = np.empty((capacity, 4), np.int64)
        self.thetas = np.empty((capacity, self.origin.size))
        self.values = np.empty(capacity)
        self.profiles = np.empty((capacity, self.profile_size))
        self.table = np.full(4 * capacity, -1, np.int64)

    def _reserve(self, count: int) -> None:
        if self.used + count > self.max_vertices:
            self._empty()
        capacity = len(self.keys)
        while capacity < self.used + count:
            capacity *= 2
        if capacity > len(self.keys):
            for name in ("keys", "thetas", "values", "profiles"):
                old = getattr(self, name)
                new = np.empty((capacity, *old.shape[1:]), old.dtype)
                new[: self.used] = old[: self.used]
                setattr(self, name, new)
            self.table = np.empty(4 * capacity, np.int64)
            shared.rebuild(self.table, self.keys, self.used)

    def find(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, slice]:
        """Slots of the boxes' vertices, and the range of slots that are new and lack a value."""
        slots = np.empty((len(lower), 2**self.origin.size), np.int64)
        self._reserve(slots.size)
        before = self.used
        self.used = shared.find_or_add(
            self.table, self.keys, self.thetas, before, self.origin, self.width, lower, upper, slots
        )
        return slots, slice(before, self.used)


class SharedBound(ModelBound):
    """The paper's linearisation at the box centre, over shared vertex values."""

    moves = 0

    def __init__(self, model: Model, threads: int = 1) -> None:
        super().__init__(model, threads)
        # in norm space all R_i are alike, and a matching of all rows is charged for all of them
        rows_differ = model.axis_weights.size == 4 and model.n_inliers < len(model.source)
        self.cache = VertexCache(model.start_box(), len(model.source) if rows_differ else 0)
        self.loss_weights = model.n_inliers * model.axis_weights**2

    def _evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        model, cache = self.model, self.cache
        slots, new = cache.find(lower, upper)

        def solve(part: slice) -> int:
            rows = slice(new.start + part.start, new.start + part.stop)
            return shared.solve_vertices(
                model.kind,
                model.source,
                model.target_features,
                model.n_inliers,
                cache.thetas[rows],
                cache.values[rows],
                cache.profiles[rows],
            )

        self._run(solve, new.stop - new.start)
        bounds = np.empty(len(lower))
        best = np.empty(len(lower), np.int64)

        def bound(part: slice) -> int:
            shared.shared_bound(
                model.kind,
                model.source,
                model.n_inliers,
                self.loss_weights,
                cache.thetas,
                cache.values,
                cache.profiles,
                slots[part],
                lower[part],
                upper[part],
                cutoff,
                self.moves,
                bounds[part],
                best[part],
            )
            return 0

        self._run(bound, len(lower))
        return Evaluation(bounds, cache.thetas[best], cache.values[best])


class TightBound(SharedBound):
    """Shared vertex values and the linearisation point that makes the bound greatest."""

    moves = 4
