"""A lower bound by congruent triples: the few poses that can have a small objective.

Let E* be the minimum of the sum of k squared residuals, and C the value to prove. The points of the
source are divided into g groups of at most s points. If E* is small, some triple of a group is nearly
congruent to its target triple. All pairs of nearly congruent triples are listed. Each allows only few
poses, and all other poses are excluded.

Averages over triples
---------------------
Suppose that every triple of a group, matched to any three target points in any order, has a sum of
squared residuals above c at every pose. A group with k_a >= 3 matched points and the sum E_a has
binom(k_a, 3) matched triples, and each of its matched points is in binom(k_a - 1, 2) of them. Hence
E_a > c k_a / 3, and E_a >= 0 for smaller k_a. For 0 <= k_a <= s, both are on or above the line through
(2, 0) and (s, s c / 3). The sum of this line over the groups gives

    E* > c v,    v = (s / 3) (k - 2 g) / (s - 2),

where a group of one or two points contributes its size instead of 2 to the term 2 g. So with c = C / v, a
pose with an objective of at most C moves at least one source triple of a group onto some target triple
with a sum of squared residuals of at most c. The poses that do so form the *region* of the two triples.

Congruence
----------
For residuals e of a triple, the sum of |e_a - e_b|^2 over its three pairs of points is at most 3 sum
|e|^2. The distance between two points of the source triple differs from that in the target triple by at
most |e_a - e_b|. So the squared differences of the three distances add up to at most 3 c, and only such
target triples are tried.

The region of two triples
-------------------------
Let c_0 be the minimum of the sum of squared residuals over all poses, attained at the pose (R_0, t_0),
and S the symmetric factor of sum R_0^T y x^T, with both triples centred. Let a rotation have an axis and
an angle relative to R_0, and let w = 2 sin(angle / 2) axis. Let t' be the displacement of the moved
centroid of the source triple from that of the target triple. Then the sum is, for every angle,

    c_0 + 3 |t'|^2 + w^T M w,    M = tr(S) I - S,

because R - I is 2 sin^2(angle / 2) (a a^T - I) plus an antisymmetric matrix, where a is the axis. The
region is the ellipsoid 3 |t'|^2 + w^T M w <= rho^2 = c - c_0. S has rank two and no negative eigenvalue:
if the target triple has the other orientation in its plane, R_0 turns the plane over. M depends on the
target triple. With phi the minimum generalised eigenvalue of S and the second moments of the source
triple, M >= phi M_0, where M_0 depends on the source triple only.

Exclusion
---------
A point at z from the centroid is moved by t' + w x z up to a common rotation, so |R z - R_0 z| = |w x z|.
An optimum in the region is stationary in translation and rotation: its residuals and their moments sum
to 0. With d_i the distance of a point from the target at the centre of the region and u_i its
displacement, as in `dcreg.families.rigid3d.bound`,

    E* >= sum over the matched points of (d_i^2 - |u_i|^2) - |w|^2 sqrt(E*) sqrt(I),

where I is the maximum sum of squared norms of k source points, and |w|^2 is at most rho^2 divided by the
minimum eigenvalue of M. If E* < C, the last term is at most that with C. So the region is excluded if

    minimum over k points of sum (d_i^2 - |u_i|^2)  >=  C + |w|^2 sqrt(C I).

The minimum over k points is at least k tau - sum max(0, tau - d_i^2 + |u_i|^2) for any tau. Two bounds on
the displacements are used.

*By rows.* |u_i|^2 <= rho^2 (1 / 3 + lambda_i / phi), with lambda_i the maximum eigenvalue of [z]^T
M_0^-1 [z].

*Jointly.* max(0, |u|^2 - a) is at most |u|^2 - a if a <= 0, and at most |u|^2 (1 - a / b) if |u|^2 <= b
with b the bound by rows. So the sum is at most a constant plus sum alpha_i |u_i|^2, which is a quadratic
form in (t', w). On the ellipsoid it is at most rho^2 times an eigenvalue.

Both bounds also hold for costs reduced by dual variables. `kernels.division` tests these costs at the
centre of a region, and then divides the region into parts, to which it applies the bounds of
`dcreg.families.rigid3d.bound`.

The remaining regions
---------------------
The start boxes of the search are divided, and parts that meet no remaining region are dropped. Every
optimum with an objective below C lies in a remaining box.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from dcreg.families.parallel import in_threads, stopped_after
from dcreg.families.protocol import rows_of
from dcreg.families.rigid3d.kernels.boxes import FEW_PAIRS, allocate_found
from dcreg.families.rigid3d.kernels.division import divide_regions
from dcreg.families.rigid3d.kernels.dual_bounds import allocate_workspace
from dcreg.families.rigid3d.kernels.exclusion import Distances
from dcreg.families.rigid3d.kernels.regions import improve_groups, meeting_regions
from dcreg.families.rigid3d.kernels.tuples import (
    Regions,
    Thresholds,
    allocate_regions,
    cover_triples,
)
from dcreg.families.rigid3d.space import Rigid3D, largest_subset_mean_3d
from dcreg.jit import is_compiled
from dcreg.problem.trees import Tree
from dcreg.search import Boxes, Budget, Confined, LongestEdge

GROUP_SIZES = range(3, 9)  # source points per group
SWAPS = 400  # exchanges between groups that are tried, per source point
CELLS = 96  # of the grid of distances, along the longest side
_PADDING = 0.3  # margin of the grid around the target, in RMS radii of the target
MANY_PAIRS = 500_000  # point pairs above which the triples of one group take too long
TARGET_PAIRS = 4_000_000  # ordered pairs of target points, whose distances take about 70 bytes each
_MARGIN = 1e-9  # relative; covers rounding
_ROUNDING = 1e-6  # rounding error of a distance in single precision
_SLICE, _SINGLE = 8, 16  # source triples per slice; number of slices of one triple at the start
_ROOM = 300_000  # maximum number of regions of a slice
_UNLIMITED = 1e15  # parts of the regions of a slice if the time is unlimited
MAX_PARTS = 4000  # of a region that are bounded before the region is left to the search
MAX_LEFT = 20_000  # regions that may be left to the search
# Start boxes are divided until the RMS displacement along their longest edge is at most SMALL, in RMS
# radii of the target, or until more than FEW_BOXES boxes or MAX_MEETINGS pairs of box and region exist.
SMALL, FEW_BOXES, MAX_MEETINGS = 0.4, 20_000, 5_000_000
# Nominal seconds, the same on every machine: per congruent triple and source point; per region and point
# pair; per part of a region and point pair. The time allowed depends on the time limit and the threads.
TRIPLE_S, REGION_S, PART_S = 2.1e-9, 4e-9, 6e-10
BOX_S = 2.7e-9  # of the search, per box and point pair
SAMPLED = 0.05  # share of the allowed time that the slices of one triple may take


@dataclass(frozen=True)
class Grouping:
    """Groups of source points; see the module's docstring.

    Attributes
    ----------
    groups : (g, s) int array
        Indices of source points; -1 where a group has fewer than s.
    factor : float
        The factor v.
    """

    groups: np.ndarray
    factor: float

    @property
    def triples(self) -> np.ndarray:
        """Return the (T, 3) triples of all groups."""
        columns = list(itertools.combinations(range(self.groups.shape[1]), 3))
        triples = self.groups[:, columns].reshape(-1, 3)
        return triples[(triples >= 0).all(axis=1)]


def factor_of(sizes: np.ndarray, k: int) -> float:
    """Return v: a matching of k points costs at least v times the minimum cost of a triple; 0 if none."""
    largest = int(sizes.max())
    if largest < 3:
        return 0.0
    free = int(np.minimum(sizes, 2).sum())
    return max(0.0, largest / 3.0 * (k - free) / (largest - 2))


def best_grouping(points: np.ndarray, k: int) -> Grouping | None:
    """Return groups of (n, 3) points whose triples are far from collinear; None if k is too small.

    The size of the groups balances the number of triples and the size of their regions.
    """
    options = []
    for size in GROUP_SIZES:
        groups = _dealt(len(points), size)
        grouping = Grouping(groups, factor_of((groups >= 0).sum(axis=1), k))
        if grouping.factor > 0.0:
            options.append((len(grouping.triples) / grouping.factor**2.5, size, grouping))
    if not options:
        return None
    groups = min(options, key=lambda option: option[:2])[2].groups
    swaps = np.random.default_rng(0).integers(
        np.array([*groups.shape, *groups.shape]), size=(SWAPS * len(points), 4)
    )
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    improve_groups(squares, groups, swaps)
    return Grouping(groups, factor_of((groups >= 0).sum(axis=1), k))


def _dealt(count: int, size: int) -> np.ndarray:
    """Deal point indices to groups of `size` in random order; -1 fills the remaining places."""
    order = np.random.default_rng(0).permutation(count)
    groups = np.full(size * -(-count // size), -1)
    groups[:count] = order
    return np.ascontiguousarray(groups.reshape(size, -1).T)


def distances_to(target: np.ndarray) -> Distances:
    """Return lower bounds on the distance to (m, 3) points, on a grid that contains them."""
    lower, upper = target.min(axis=0), target.max(axis=0)
    cell = float((upper - lower).max() + 2.0 * _PADDING) / CELLS
    origin = lower - _PADDING
    sizes = np.ceil((upper + _PADDING - origin) / cell).astype(int)
    axes = [origin[c] + (np.arange(sizes[c]) + 0.5) * cell for c in range(3)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = Tree(target).nearest(centres)[0].reshape(sizes) * (1.0 - _ROUNDING) - _ROUNDING
    return Distances(origin, cell, values.astype(np.float32))


def limits_around(centres: np.ndarray, source: np.ndarray, k: int) -> np.ndarray:
    """Return the (T, 3) `Limits` of any k of (n, 3) source points around each of T centres."""
    squares = ((source - centres[:, None]) ** 2).sum(axis=2)
    inertia = np.sort(squares, axis=1)[:, -k:].sum(axis=1)
    drift = k * (largest_subset_mean_3d(source, k) + np.linalg.norm(centres, axis=1))
    moments = source.T @ source + len(source) * centres[:, :, None] * centres[:, None, :]
    middle = np.outer(source.sum(axis=0), np.ones(3))
    moments = moments - centres[:, :, None] * middle.T - middle * centres[:, None, :]
    return np.column_stack([inertia, drift, np.linalg.eigvalsh(moments)[:, -1]])


class CongruentCover:
    """Finds few boxes that contain every optimum below a value; see the module's docstring.

    Parameters
    ----------
    space : Rigid3D
    threads : int
    """

    stage = "triples"
    # Small shares of the cutoff take little time to prove. The last share is tried only if the whole
    # cutoff takes too long.
    shares = 0.0625, 0.25, 1.0, 0.5

    def __init__(self, space: Rigid3D, threads: int = 1) -> None:
        self._space, self.threads = space, threads
        self._source = np.ascontiguousarray(space.clouds.source.T)
        self._target = np.ascontiguousarray(space.clouds.target.T)
        self._limits = np.empty((0, 3))
        self._triples: np.ndarray | None = None
        self.proven = 0.0, 0.0
        self._spent_s = 0.0
        self._stop = space.stop_flag
        self.box_s = BOX_S * space.n_pairs

    @property
    def applies(self) -> bool:
        """Whether translations vary and the numbers of pairs are in the useful ranges."""
        box = self._space.translations()
        is_long = FEW_PAIRS < self._space.n_pairs <= MANY_PAIRS
        is_long = is_long and self._space.n_target**2 <= TARGET_PAIRS
        return is_long and bool((box.lower < box.upper).any())

    @property
    def is_compiled(self) -> bool:
        """Whether nothing remains to be compiled."""
        return is_compiled(divide_regions)

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
            None if this takes too long or leaves too many regions.

        Raises
        ------
        Interrupted
        """
        if not self._prepare() or self._known_s(cutoff) > allowed_s:
            return None
        began, n_tried, regions = budget.elapsed(), 0, []
        # the nominal seconds of a slice can be far too low
        limit_s = np.inf if budget.is_counted else allowed_s / self.threads
        with stopped_after(limit_s, self._space.stop_flag) as self._stop:
            for tried, found, is_affordable in self._slices(cutoff, allowed_s):
                if self._stop[0] or not is_affordable:
                    return None
                n_tried += tried
                regions.append(found)
                if sum(len(each.triple) for each in regions) > MAX_LEFT:
                    return None
        self.proven = cutoff, self._spent_s
        boxes = self._boxes(Regions(*map(np.concatenate, zip(*regions, strict=True))))
        return Confined(boxes, cutoff, budget.elapsed() - began, n_tried, self.stage)

    def _known_s(self, cutoff: float) -> float:
        """Return the nominal seconds, extrapolated from the last cutoff (power 1.5); 0 if unknown."""
        done, spent_s = self.proven
        return spent_s * (cutoff / done) ** 1.5 if done > 0.0 else 0.0

    def _prepare(self) -> bool:
        """Compute once what does not depend on the cutoff; return whether k is large enough."""
        if self._triples is not None:
            return len(self._triples) > 0
        k, target = self._space.n_inliers, self._target
        grouping = best_grouping(self._source, k)
        if grouping is None:
            self._triples = np.empty((0, 4), np.int64)
            return False
        # in random order, so that the first triples predict the time of all
        triples = np.random.default_rng(0).permutation(grouping.triples)
        self._factor = grouping.factor
        self._triples = np.column_stack([triples, np.arange(len(triples))])
        self._frames = np.empty((len(triples), 7))
        self._limits = limits_around(self._source[triples].mean(axis=1), self._source, k)
        self._inertia = float(np.sort((self._source**2).sum(axis=1))[-k:].sum())
        distances = np.sqrt(((target[:, None] - target) ** 2).sum(axis=2))
        first, second = np.nonzero(~np.eye(len(target), dtype=bool))
        order = np.argsort(distances[first, second], kind="stable")
        lengths = distances[first, second][order]
        self._pairs = first[order], second[order], lengths, distances
        self._field = distances_to(target)
        return True

    def _slices(self, cutoff: float, allowed_s: float) -> Iterator[tuple[int, Regions, bool]]:
        """Yield by slices the number of congruent triples, the regions left, and whether to continue."""
        assert self._triples is not None
        thresholds = Thresholds(
            cutoff / self._factor * (1.0 + _MARGIN), cutoff * (1.0 + _MARGIN),
            self._space.n_inliers, self._inertia,
        )  # fmt: skip
        total, done, self._spent_s = len(self._triples), 0, 0.0
        # slices of one triple first, because a single triple of a large cloud can take seconds
        edges = [*range(min(_SINGLE, total)), *range(min(_SINGLE, total), total, _SLICE), total]
        parts = [slice(*ends) for ends in itertools.pairwise(edges)]
        # a slice that needs more parts is abandoned, because all slices together would take too long
        room = max(SAMPLED, _SLICE / total) * allowed_s / (PART_S * self._space.n_pairs)
        work = partial(self._slice, thresholds=thresholds, room=int(min(room, _UNLIMITED)))
        for part, (tried, found, spent_s) in zip(
            parts, in_threads(work, parts, self.threads), strict=True
        ):
            self._space.check()
            self._spent_s += spent_s
            done = part.stop
            share = max(done / total, SAMPLED if done < _SINGLE else 0.0)
            yield tried, found, self._spent_s <= allowed_s * share

    def _slice(self, part: slice, thresholds: Thresholds, room: int) -> tuple[int, Regions, float]:
        """Return the number of congruent triples of a slice, the regions left, and the nominal seconds.

        The latter are inf if there are too many regions, or more than `room` parts of them.
        """
        space, frames = self._space, self._frames
        assert self._triples is not None
        feasible = np.empty((0, 0), np.bool_)
        if space.candidates is not None:
            feasible = np.ascontiguousarray(space.candidates)
        found = allocate_regions(_ROOM)
        tried, count = cover_triples(
            self._triples[part], frames[part], (self._source, self._target), feasible, self._pairs,
            (thresholds, self._field), self._stop, found,
        )  # fmt: skip
        found = rows_of(found, slice(0, min(count, _ROOM)))
        if count > _ROOM:
            return tried, found, np.inf
        left = allocate_regions(_ROOM)
        one = allocate_found(np.zeros((1, space.n_target), np.uint16))
        scratch = one, allocate_workspace(space.n_source, space.n_target)
        n_left, n_parts = divide_regions(
            found, frames, self._limits, space.clouds._replace(stop=self._stop), thresholds,
            (MAX_PARTS, room), scratch, left,
        )  # fmt: skip
        kept = rows_of(left, slice(0, min(n_left, _ROOM)))
        spent_s = tried * TRIPLE_S * space.n_source
        spent_s += (count * REGION_S + n_parts * PART_S) * space.n_pairs
        spent_s = spent_s if n_left <= _ROOM and n_parts <= room else np.inf
        return tried, Regions(*(values.copy() for values in kept)), spent_s

    def _boxes(self, regions: Regions) -> Boxes:
        """Divide the start boxes until they are small or many; return those that meet a region."""
        boxes = Boxes.of(self._space.roots())
        weights, ids = self._space.axis_weights, np.arange(len(regions.triple), dtype=np.int32)
        starts, ids = np.arange(len(boxes) + 1) * len(ids), np.tile(ids, len(boxes))
        branching = LongestEdge(weights)
        while 0 < len(boxes) <= FEW_BOXES and len(ids) <= MAX_MEETINGS:
            self._space.check()
            if ((boxes.upper - boxes.lower)[0] * weights).max() <= SMALL:
                break
            halves, out = branching(boxes), np.empty(2 * len(ids), np.int32)
            ends = meeting_regions(
                halves.lower, halves.upper, starts, ids, self._frames, regions, out
            )
            kept = np.flatnonzero(np.diff(ends) > 0)
            boxes, ids = halves[kept], out[: ends[-1]]
            starts = np.concatenate([[0], ends[1:][kept]])
        return boxes
