"""DC bounds over shared vertex values: one assignment a lattice vertex instead of one a box vertex.

For any linearisation point theta0 the DC bound of a box is

    LB(M; theta0) = min_{v in V(M)} min_P sum p_ij [ E_ij(v) - R_i(v - theta0) ].

The costs E_ij(v) do not depend on the box, and R_i charges whole rows. So one exact assignment at a
vertex, kept with its dual profile r (`dcreg.kernels.shared.solve_vertices`), bounds the inner minimum for
every box that has the vertex and for every theta0. A bisection needs its new vertices only, and theta0
may be moved to where the bound is greatest without any assignment. Most vertices need no assignment
either: the mean of the neighbours' duals gives a profile nearly as good, and only where such a vertex
limits a box that is not yet pruned is it solved. Derived in this project, not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.bounds.base import SpaceBound
from dcreg.kernels import shared
from dcreg.search import Box, Evaluation
from dcreg.spaces import FeatureSpace

# A cache beyond this forgets the half not met for longest: bounds stay valid, some vertices are solved
# twice.
MAX_CACHE_BYTES = 400 * 2**20
_FIRST = 4096  # vertices there is room for at first


class VertexCache:
    """What is known at the vertices met so far, by their place on the start box's dyadic lattice.

    ``lows`` bounds E from below; ``values`` is E where it was solved, else infinite; ``duals`` and
    ``profiles`` as in `dcreg.kernels.shared`, ``levels`` the k-th smallest entry of the profile, about.

    Parameters
    ----------
    start : Box
        Every box asked for is made from it by bisection.
    profile_size, duals_size : int
        Entries of a profile and of a dual vector; 0 where none is needed.
    """

    _ARRAYS = ("keys", "thetas", "lows", "values", "levels", "profiles", "duals", "met")

    def __init__(self, start: Box, profile_size: int, duals_size: int) -> None:
        self.origin, self.width = start.lower, start.upper - start.lower
        self.max_vertices = MAX_CACHE_BYTES // (8 * (profile_size + duals_size + 16))
        self.used = self._calls = 0
        self.keys = np.empty((_FIRST, 4), np.int64)
        self.met = np.empty(_FIRST, np.int64)  # the last call that asked for it
        self.thetas = np.empty((_FIRST, self.origin.size))
        self.lows, self.values, self.levels = (np.empty(_FIRST) for _ in range(3))
        self.profiles, self.duals = (
            np.empty((_FIRST, size)) for size in (profile_size, duals_size)
        )
        self.table = np.full(4 * _FIRST, -1, np.int64)

    def _reserve(self, count: int) -> None:
        if self.used + count > self.max_vertices:
            self._forget()
        needed = self.used + count
        if needed > len(self.keys):
            # room for all at once: pages never written take no memory, copying again takes time
            for name in self._ARRAYS:
                old = getattr(self, name)
                new = np.empty((max(needed, self.max_vertices), *old.shape[1:]), old.dtype)
                new[: self.used] = old[: self.used]
                setattr(self, name, new)
        if 2 * needed > len(self.table):
            self.table = np.empty(8 * 2 ** int(needed).bit_length(), np.int64)
            shared.rebuild(self.table, self.keys, self.used)

    def _forget(self) -> None:
        """Keep the half of the vertices that was met last."""
        keep = np.sort(np.argsort(self.met[: self.used], kind="stable")[self.used // 2 :])
        for name in self._ARRAYS:
            array = getattr(self, name)
            array[: keep.size] = array[keep]
        self.used = keep.size
        shared.rebuild(self.table, self.keys, self.used)

    def find(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, int]:
        """Slots of the boxes' vertices (-1 beyond the last), and the first slot that is new."""
        slots = np.full((len(lower), 2**self.origin.size), -1, np.int64)
        self._reserve(slots.size)
        self._calls += 1
        before = self.used
        self.used = shared.find_or_add(
            self.table,
            self.keys,
            self.thetas,
            self.met,
            self._calls,
            before,
            self.origin,
            self.width,
            lower,
            upper,
            slots,
        )
        return slots, before


class SharedBound(SpaceBound[FeatureSpace]):
    """The paper's linearisation at the box centre, over shared vertex values."""

    moves = 0

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        n, m = len(space.source), space.target_features.shape[1]
        # in norm space all R_i are alike: the value alone gives every bound exactly
        sizes = (0, 0) if space.axis_weights.size == 3 else (n, m)
        self.cache = VertexCache(self.roots[0], *sizes)
        self.loss_weights = space.n_inliers * space.axis_weights**2

    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation:
        cache = self.cache
        slots, before = cache.find(lower, upper)
        self._estimate(slots, before)
        bounds = np.empty(len(lower))
        binding, points = np.empty(len(lower), np.int64), 0.5 * (lower + upper)
        rows = np.arange(len(lower))
        while rows.size:
            bounds[rows], binding[rows], points[rows] = self._bound(
                slots[rows], lower[rows], upper[rows], cutoff, points[rows]
            )
            # where an estimate limits a box that is not pruned yet, the vertex is solved
            rows = rows[(bounds[rows] < cutoff) & np.isinf(cache.values[binding[rows]])]
            which = np.unique(binding[rows])
            self._blend(slots, which, settled=0)
            self._solve(which, warm=True)
        self._tighten(slots, points, cutoff, bounds)
        best = np.where(slots >= 0, cache.values[slots], np.inf).argmin(axis=1)
        best = slots[np.arange(len(slots)), best]
        return Evaluation(bounds, cache.thetas[best], cache.values[best])

    def _estimate(self, slots: np.ndarray, before: int) -> None:
        """Value or lower bound of the vertices from `before` on."""
        cache, space = self.cache, self.space
        new = np.arange(before, cache.used)
        cache.values[new] = np.inf
        known = self._blend(slots, new, settled=before)
        self._solve(new[~known])
        new = new[known]

        def work(part: slice) -> int:
            shared.estimate_vertices(
                space.kind,
                space.source,
                space.target_features,
                space.n_inliers,
                new[part],
                cache.thetas,
                cache.lows,
                cache.values,
                cache.levels,
                cache.profiles,
                cache.duals,
            )
            return 0

        self._run(work, new.size)

    def _blend(self, slots: np.ndarray, which: np.ndarray, settled: int) -> np.ndarray:
        """Prices from neighbours; False where there are none."""
        cache = self.cache
        known = np.zeros(which.size, np.bool_)
        if not cache.duals.shape[1] or not which.size:
            return known

        start, boxes = shared.boxes_of(slots, which)

        def work(part: slice) -> int:
            shared.blend_prices(
                slots,
                which[part],
                start[part.start :],
                boxes,
                settled,
                cache.thetas,
                cache.values,
                self.loss_weights,
                cache.duals,
                known[part],
            )
            return 0

        self._run(work, which.size)
        return known

    def _solve(self, which: np.ndarray, warm: bool = False) -> None:
        """Exact values, duals and profiles at the vertices `which`; `warm`: from their estimates."""
        cache, space = self.cache, self.space

        def work(part: slice) -> int:
            return shared.solve_vertices(
                space.kind,
                space.source,
                space.target_features,
                space.n_inliers,
                warm,
                which[part],
                cache.thetas,
                cache.lows,
                cache.values,
                cache.levels,
                cache.profiles,
                cache.duals,
            )

        self._run(work, which.size)

    def _bound(
        self,
        slots: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        cutoff: float,
        points: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        cache, space = self.cache, self.space
        bounds, binding = np.empty(len(lower)), np.empty(len(lower), np.int64)

        def work(part: slice) -> int:
            shared.shared_bound(
                space.kind,
                space.source,
                space.n_inliers,
                self.loss_weights,
                cache.thetas,
                cache.lows,
                cache.levels,
                cache.profiles,
                slots[part],
                lower[part],
                upper[part],
                cutoff,
                self.moves,
                bounds[part],
                binding[part],
                points[part],
            )
            return 0

        self._run(work, len(lower))
        return bounds, binding, points

    def _tighten(
        self, slots: np.ndarray, points: np.ndarray, cutoff: float, bounds: np.ndarray
    ) -> None:
        """Nothing: profiles are all this bound uses."""


class TightBound(SharedBound):
    """Shared vertex values and the linearisation point that makes the bound greatest.

    In norm space also with the curvature of E in the box (`dcreg.kernels.norm_bound`).
    """

    moves = 2


class TightExactBound(TightBound):
    """`TightBound`, then the exact assignment of ``E_ij(v) - R_i`` at the vertices that limit a box.

    A profile charges the rows of one matching; where few of many points are matched (k < n) another
    matching may suffer less from the charge, and only an assignment of its own tells.
    """

    def _tighten(
        self, slots: np.ndarray, points: np.ndarray, cutoff: float, bounds: np.ndarray
    ) -> None:
        cache, space = self.cache, self.space
        if not cache.profiles.shape[1]:  # all R_i alike: nothing to gain
            return
        weak = np.flatnonzero(bounds < cutoff)
        raised = bounds[weak]

        def work(part: slice) -> int:
            return shared.exact_bound(
                space.kind,
                space.source,
                space.target_features,
                space.n_inliers,
                cache.thetas,
                cache.lows,
                cache.levels,
                cache.profiles,
                cache.duals,
                slots[weak[part]],
                points[weak[part]],
                cutoff,
                raised[part],
            )

        self._run(work, weak.size)
        bounds[weak] = raised
