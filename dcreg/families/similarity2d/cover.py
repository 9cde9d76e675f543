"""A lower bound in 2D by distances to the nearest points: the few boxes with a small objective.

Let C be the value to prove. Points and parameters are complex numbers. A box has the centre (a_0, t_0),
which moves the source point x_i to a_0 x_i + t_0. A parameter (a_0 + w, t_0 + t) of the box displaces
this image by u_i = w x_i + t. Let c_ij(a_0, t_0) be the squared residual of pair (i, j) at the centre.

Let an optimum in the box have the objective E* < C and the matching P. The objective of P is quadratic
in the parameters. If the scale of the optimum lies inside its range, the optimum is stationary, hence

    sum over P of c_ij(a_0, t_0)  =  E* + sum over P of |u_i|^2.

If the scale is at an end of its range, the gradient with respect to a is radial: outwards at the lower
end and inwards at the upper end. Its norm is at most 2 sqrt(E* I), where I is the maximum sum of squared
norms of k source points. The right-hand side then has a further term of at most

    2 sqrt(C I) max(0, |a_0| - low)    or    sqrt(C I) max(0, high^2 - |a_0|^2 + max |w|^2) / high,

where low and high are the ends of the range. The reason is that the inner product of a_0 with the
direction of the optimum is at most |a_0|, and at least (|a_0|^2 + high^2 - |w|^2) / (2 high). With this
term as l, the box is excluded if the minimum of the sum of c_ij - |u_i|^2 over all matchings of k pairs
is at least C + l. Two tests bound this minimum from below.

*From the target.* c_ij is at least the squared distance of the target point y_j from the moved source.
The losses |u_i|^2 of any k points add up to at most k |t|^2 + |w|^2 I + 2 |t| |w| S, where S is the
maximum norm of a sum of k source points. This test excludes small scales, where many source points are
close to the same target point.

*From the source.* c_ij is also at least d_i^2, the squared distance of the moved source point from the
target. For any tau the sum of the k smallest d_i^2 - |u_i|^2 is at least k tau - sum max(0, tau - d_i^2 +
|u_i|^2). Let o_i = d_i^2 - tau, and let b_i be the maximum of |u_i|^2 in the box. The term max(0,
|u_i|^2 - o_i) is |u_i|^2 - o_i if o_i <= 0, at most |u_i|^2 (1 - o_i / b_i) if 0 < o_i < b_i, and
otherwise 0. So the sum is at most a quadratic form in (w, t) plus a constant, and its maximum is at a
vertex of the box. The kernels choose the k-th smallest d_i^2 as tau.

A box is divided until all its parts are excluded, until both sums of the k smallest squared distances at
its centre are below C, or until it is small.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from dcreg.families.parallel import in_threads, stopped_after
from dcreg.families.similarity2d.kernels.exclusion import Distances, Sides, divide_boxes
from dcreg.families.similarity2d.space import Similarity2D, largest_subset_mean
from dcreg.jit import is_compiled
from dcreg.problem.trees import Tree
from dcreg.search import Boxes, Budget, Confined, LongestEdge

CELLS = 640  # of the grid of distances, along the longest side
_PADDING = 0.3  # margin of the grid around the points, as a share of the longest side
_ROUNDING = 1e-6  # rounding error of a distance in single precision
_MARGIN = 1e-9  # relative; covers rounding
FEW_PAIRS = 1000  # point pairs up to which boxes alone are fast
_SLICES = 256  # minimum number of boxes that the start boxes are divided into; each is a slice
_UNLIMITED = 1e15  # maximum number of boxes tested in a slice if the time is unlimited
# RMS displacement along the longest edge at which a box is left to the search, in RMS radii of the target
SMALL = 0.02
MAX_LEFT = 400_000  # boxes that may be left to the search
PREDICTED = 0.25  # share of the slices after which the number of these boxes is extrapolated
BOX_S = 4.3e-9  # nominal seconds per box and point, the same on every machine
SAMPLED = 0.1  # share of the allowed time that one slice may take, or the first slices together


def distances_to(points: np.ndarray) -> Distances:
    """Return lower bounds on the squared distance to (n, 2) points, on a grid around them."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    side = max(float((upper - lower).max()), 1e-9)
    cell, origin = side * (1.0 + 2.0 * _PADDING) / CELLS, lower - _PADDING * side
    sizes = np.ceil((upper - origin + _PADDING * side) / cell).astype(int)
    axes = [origin[c] + (np.arange(sizes[c]) + 0.5) * cell for c in range(2)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    least = Tree(points).nearest(centres)[0].reshape(sizes) - np.sqrt(0.5) * cell
    least = np.maximum(0.0, least * (1.0 - _ROUNDING) - _ROUNDING * side)
    return Distances(origin, 1.0 / cell, (least**2).astype(np.float32))


def sides_of(space: Similarity2D) -> Sides:
    """Return the data of a problem that the tests need."""
    source, target = space.clouds.source, space.clouds.target
    squares, k = (source**2).sum(axis=0), space.n_inliers
    return Sides(
        source, target, np.sqrt(squares), distances_to(target.T), distances_to(source.T), k,
        float(np.sort(squares)[-k:].sum()), k * largest_subset_mean(source.T, k), *space.scale_range,
    )  # fmt: skip


class NearestCover:
    """Finds few boxes that contain every optimum below a value; see the module's docstring.

    A small value takes about as long to prove as the whole cutoff, so only the whole cutoff is proved.

    Parameters
    ----------
    space : Similarity2D
    threads : int
    """

    stage = "distances"
    shares = (1.0,)
    proven = 0.0, 0.0  # a single share needs no extrapolation
    box_s = np.inf  # it ends long before a search by boxes alone

    def __init__(self, space: Similarity2D, threads: int = 1) -> None:
        self._space, self.threads = space, threads
        self._sides: Sides | None = None
        self._stop = space.stop_flag

    @property
    def applies(self) -> bool:
        """Whether there are many point pairs and some points have no partner; else boxes suffice."""
        space = self._space
        return space.n_pairs > FEW_PAIRS and space.n_inliers < max(space.n_source, space.n_target)

    @property
    def is_compiled(self) -> bool:
        """Whether nothing remains to be compiled."""
        return is_compiled(divide_boxes)

    def confine(self, cutoff: float, budget: Budget, allowed_s: float) -> Confined | None:
        """Return boxes that contain every optimum with an objective below `cutoff`.

        Parameters
        ----------
        cutoff : float
        budget : Budget
        allowed_s : float
            Nominal seconds of CPU time.

        Returns
        -------
        Confined or None
            None if this takes too long or leaves too many boxes.

        Raises
        ------
        Interrupted
        """
        began, n_tested, kept = budget.elapsed(), 0, []
        limit_s = np.inf if budget.is_counted else allowed_s / self.threads
        slices = self._slices(cutoff * (1.0 + _MARGIN), allowed_s)
        with stopped_after(limit_s, self._space.stop_flag) as self._stop:
            for tested, found, share, is_affordable in slices:
                if self._stop[0] or not is_affordable:
                    return None
                n_tested += tested
                kept.append(found)
                if sum(map(len, kept)) > MAX_LEFT * max(share, PREDICTED):
                    return None
        lower, upper = (
            np.concatenate(parts) for parts in zip(*((b.lower, b.upper) for b in kept), strict=True)
        )
        return Confined(Boxes(lower, upper), cutoff, budget.elapsed() - began, n_tested, self.stage)

    def _slices(self, cutoff: float, allowed_s: float) -> Iterator[tuple[int, Boxes, float, bool]]:
        """Yield for each slice the boxes tested and left, the share done, and whether to continue."""
        if self._sides is None:
            self._sides = sides_of(self._space)
        starts, branching = Boxes.of(self._space.roots()), LongestEdge(self._space.axis_weights)
        while len(starts) < _SLICES:
            starts = branching(starts)
            starts = starts[np.flatnonzero(self._space.touches(starts.lower, starts.upper))]
        # in random order, so that the first slices predict the time of all
        starts = starts[np.random.default_rng(0).permutation(len(starts))]
        box_s = BOX_S * (self._space.n_source + self._space.n_target)
        work = partial(
            self._slice, cutoff=cutoff, most=int(min(SAMPLED * allowed_s / box_s, _UNLIMITED))
        )
        parts = [starts[at : at + 1] for at in range(len(starts))]
        spent_s = 0.0
        for done, (tested, found, is_whole) in enumerate(
            in_threads(work, parts, self.threads), start=1
        ):
            self._space.check()
            spent_s += tested * box_s
            share = done / len(parts)
            is_affordable = spent_s <= min(1.0, SAMPLED + 2.0 * share) * allowed_s
            yield tested, found, share, is_whole and is_affordable

    def _slice(self, start: Boxes, cutoff: float, most: int) -> tuple[int, Boxes, bool]:
        """Return the number of boxes tested, the boxes left, and whether these are complete."""
        assert self._sides is not None
        lower, upper = np.empty((2, MAX_LEFT, 4))
        n_left, n_tested = divide_boxes(
            (start.lower, start.upper), self._sides, cutoff, self._space.axis_weights, (SMALL, most),
            self._stop, (lower, upper),
        )  # fmt: skip
        is_whole = n_left <= MAX_LEFT and n_tested < most
        kept = slice(0, min(n_left, MAX_LEFT))
        return n_tested, Boxes(lower[kept].copy(), upper[kept].copy()), is_whole
