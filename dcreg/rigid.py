"""The rigid pose itself, searched globally: modes `full` and `multi` of the 3D pipeline.

Solved is, for points x_i, y_j and k pairs,

    min over R in SO(3), t in R^3 and one-to-one P of k pairs of  sum_ij p_ij |R x_i + t - y_j|^2,

the objective that the norm space of the paper only bounds from below. theta is a quaternion of any
length followed by t; the quaternions are the four facets of `dcreg.rotation`. Bounded is, over a
box of quaternions times a box of translations with centres R_c, t_c, the least E. Below, x_i stands
for R_c x_i and y_j for y_j - t_c, so that the centre of the box is (R, t) = (I, 0); t lies within
half-widths h, rho = |h|, and r_a are the Gibbs vectors (axis times tan of half the angle) of the
corners of the quaternion box, seen from its centre.

Start box
---------
For fixed pairs the best t is mean(y) - R mean(x), so an optimum has one within the means of any k
targets, widened by the length of the mean of any k sources. Where all points of both sets match
and both are centred, that is the single value 0 and only the rotation is searched.

Which rotations a box holds
---------------------------
Seen from the centre, quaternion corners v_a become p_a = v_a conj(q_c); q = sum c_a v_a, c >= 0,
becomes p = sum c_a p_a, and its Gibbs vector (p_x, p_y, p_z) / p_w is, when all p_a,w > 0, the
convex combination of the r_a with weights c_a p_a,w / p_w. So the r of the box lie in the convex
hull of the r_a, and no rotation turns by more than the angle 2 atan(max |r_a|). Else: pi.

First bound: caps
-----------------
Turned by at most that angle, x_i stays on a spherical cap. With d_ij the distance of y_j from the
cap, |R x_i + t - y_j| >= d_ij - rho. Also |R x_i - x_i| <= 2 sin(angle / 2) |x_i| =: g_i, thus
|R x_i + t - y_j| >= dist(y_j - x_i, box of t) - g_i. The greater of the two, cut at 0 and squared,
is a cost of the pair alone. E is at least the k-assignment of these costs; at least their
`dual_bound` for any duals b >= 0, for which a rough auction (`bid`) is enough; and at least the sum
of the k smallest row minima (`nearest_bound`, of d_ij - rho alone). With all rotations in the box
this is the norm bound (|x + t| - |y|)^2 of the paper's Case II. First order in the box.

Second bound: Cayley's form
---------------------------
R = (I - [r])^-1 (I + [r]) for Gibbs vector r. For any vector v, |(I - [r]) v|^2 = |v|^2 + |r x v|^2
<= (1 + |r|^2) |v|^2. With v = R x + t - y,

    (I - [r]) v = (I + [r]) x + (I - [r]) (t - y) = x - y + s + r x (x + y),    s = t - r x t,

    (1 + |r|^2) |R x + t - y|^2  >=  |x - y + s + r x (x + y)|^2:

a linear residual in delta = (r, s), with s in the box of half-widths h'_c = h_c + the largest
|r x t|_c. Nothing but |r|^2 times the residual is lost, which is small where E is. Squares are
convex: with e = x - y + s0 + r0 x (x + y) at any delta0 the right side is at least

    |e|^2 + 2 e.(s - s0) + 2 ((x + y) x e).(r - r0),

affine in delta. Its minimum over the matchings is concave, so over conv{r_a} times the box of s it
is least at one of 8 x 8 vertices; divided by 1 + max |r_a|^2 and cut at 0 it bounds E. All values
of delta0 are valid. Best is the least-squares fit of a good matching within the box: while that
matching stays the best one at the vertices, the bound is the exact minimum over the box of its sum,
and the curvature of E costs nothing. This is DC-Reg's linearisation, with the point chosen as in
its planar case. As in `dcreg.rotation`, a vertex is bounded by duals and solved only if binding.

A box is bounded by the greatest of these, cheapest first and only as far as it decides. At a
single pose the first is E.

Feasible pairs
--------------
Pairs that may not be matched cost a constant more, in E and in every cost above. Feasible matchings
cost what they did, so the least over all matchings is still no more than the least over those: the
bounds hold whatever the constant. For E itself no other pair may be matched, so the constant exceeds
k squared residuals at any pose of the start box (`dcreg.models.base.with_prices`).
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from dataclasses import dataclass, field

import numpy as np

from dcreg.bounds import make_bound
from dcreg.box import Box, LongestEdge
from dcreg.kernels import rigid as kernels
from dcreg.models import Translation3D
from dcreg.models.base import mean_of_largest, radius, with_prices
from dcreg.result import Status
from dcreg.rotation import RotationBound, RotationModel
from dcreg.search import Evaluation, Limits, SearchResult, branch_and_bound
from dcreg.threads import Workers
from dcreg.trace import Event, Listener

# A unit step of a facet coordinate turns by 1 to 2 radians, which moves points at the RMS radius
# by about this much; a unit step of the translation moves them by one.
_AXIS_WEIGHTS = np.array([1.3, 1.3, 1.3, 1.3, 1.0, 1.0, 1.0])
# Pairs looked at when poses of a grid are scored for the first incumbent, and descents then made.
_SCORED_PAIRS = 20_000_000
_START_DESCENTS = 24
_ROUND_PAIRS = 1_000_000
# Of mode `multi`: descents in norm space; the gap of a basin's rotation as a share of its value, wide
# because a joint descent follows.
_NORM_DESCENTS = 100
_BASIN_GAP = 0.5
_ROUNDING = 1e-12
SCOPE_FULL = "rigid pose"
SCOPE_MULTI = "translation in norm space, best of its basins"


@dataclass(frozen=True)
class RigidResult:
    """The best rigid pose found, with bounds on the optimum of the certified objective.

    Attributes
    ----------
    T : (4, 4) array
        Proper rigid pose, source to target.
    lower_bound, upper_bound : float
        In mode `full` of the rigid objective, `upper_bound` being its value at `T`.
    n_nodes, n_assignments : int
    status : Status
    time_s : float
    scope : str
        What the bounds speak of.
    events : list of Event
    """

    T: np.ndarray
    lower_bound: float
    upper_bound: float
    n_nodes: int
    n_assignments: int
    status: Status
    time_s: float
    scope: str = SCOPE_FULL
    events: list[Event] = field(default_factory=list)


def largest_subset_mean(points: np.ndarray, count: int, cells: int = 8) -> float:
    """An upper bound on ``|mean of any `count` points|`` in space.

    The support function of the subset means is the mean of the largest projections. Directions are
    sampled at the cell centres of the faces of a cube: another point of a cell is at most sqrt(2) /
    cells away and both have length >= 1, so they differ by an angle of at most 2 asin(distance / 2).
    """
    steps = (2.0 * np.arange(cells) + 1.0) / cells - 1.0
    face = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    half = np.concatenate([np.insert(face, axis, 1.0, axis=1) for axis in range(3)])
    directions = half / np.linalg.norm(half, axis=1, keepdims=True)
    projections = np.sort(points @ np.concatenate([directions, -directions]).T, axis=0)
    farthest = max(0.0, float(projections[-count:].mean(axis=0).max()))
    return farthest / np.cos(2.0 * np.arcsin(np.sqrt(0.5) / cells))


class RigidModel:
    """Rigid poses of centred clouds; theta is a quaternion and a translation, y = R x + t.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
        n <= m is best: nearest distances are taken from the source.
    n_inliers : int
    reduced_box : bool
        Start from the translations that an optimum can have, or from the plain safe box.
    candidates : (n, m) bool array, optional
        The feasible pairs.
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        reduced_box: bool = True,
        candidates: np.ndarray | None = None,
    ) -> None:
        self.source = np.ascontiguousarray(np.asarray(source, dtype=np.float64).T)
        target = np.asarray(target, dtype=np.float64)
        reach = radius(source) + radius(target)
        self.target = with_prices(target.T, candidates, n_inliers, reach)
        self.n_inliers = n_inliers
        self.reduced_box = reduced_box

    def translations(self) -> Box:
        """A box that holds the translation of every optimum."""
        k = self.n_inliers
        if self.reduced_box:
            if k == self.source.shape[1]:
                reach = float(np.linalg.norm(self.source.mean(axis=1)))
            else:
                reach = largest_subset_mean(self.source.T, k)
            lower = np.array([-mean_of_largest(-y, k) for y in self.target[:3]])
            upper = np.array([mean_of_largest(y, k) for y in self.target[:3]])
            # rounding must not cut off the optimum, yet a centred set keeps zero width
            reach = 0.0 if reach < _ROUNDING else reach
            lower, upper = (np.where(np.abs(v) < _ROUNDING, 0.0, v) for v in (lower, upper))
            return Box(lower - reach, upper + reach)
        reach = float(sum(kernels.column_norms(p).max() for p in (self.source, self.target)))
        return Box(np.full(3, -reach), np.full(3, reach))

    def roots(self) -> list[Box]:
        """Together they hold every optimum."""
        box = self.translations()
        return [
            Box(np.append(facet.lower, box.lower), np.append(facet.upper, box.upper))
            for facet in RotationModel.roots()
        ]

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """E at a pose and the column matched to every source row (-1: none)."""
        return kernels.objective(theta, self.source, self.target, self.n_inliers)

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and best pose from `theta`: theta, objective, assignments."""
        theta, value, spent = kernels.refine(theta, self.source, self.target, self.n_inliers)
        theta[:4] /= theta[:4][np.argmax(np.abs(theta[:4]))]
        return theta, value, spent

    def start(self, time_limit: float | None = None) -> tuple[np.ndarray, float, int]:
        """Best of some descents from a grid of poses: theta, objective, assignments.

        At least one descent is made, however short the time.
        """
        began = time.perf_counter()
        grid = self._grid()
        scores = kernels.nearest_scores(grid, self.source, self.target, self.n_inliers)
        order = np.argsort(scores, kind="stable")
        theta, value, spent = self.refine(grid[order[0]])
        for at in order[1:_START_DESCENTS]:
            if time_limit is not None and time.perf_counter() - began > time_limit:
                break
            other, other_value, assignments = self.refine(grid[at])
            spent += assignments
            if other_value < value:
                theta, value = other, other_value
        return theta, value, spent

    def _grid(self) -> np.ndarray:
        """Regular poses, as many as may be scored in a moment; always with t at the box centre."""
        box = self.translations()
        n_pairs = self.source.shape[1] * self.target.shape[1]
        per_axis = 3 if 27 * 256 * n_pairs <= 5 * _SCORED_PAIRS else 1
        cells = 4 if per_axis**3 * 256 * n_pairs <= 5 * _SCORED_PAIRS else 2
        steps = (2.0 * np.arange(cells) + 1.0) / cells - 1.0
        facet = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        turns = np.concatenate([np.insert(facet, axis, 1.0, axis=1) for axis in range(4)])
        offsets = (np.arange(per_axis) - per_axis // 2) / max(1, per_axis)
        shifts = np.array(list(itertools.product(offsets, repeat=3))) * (box.upper - box.lower)
        shifts = np.unique(shifts, axis=0) + box.centre
        return np.concatenate(
            [np.repeat(turns, len(shifts), axis=0), np.tile(shifts, (len(turns), 1))], axis=1
        )


class RigidBound:
    """The greatest of the bounds in the module's docstring, over boxes of poses.

    Boxes are bounded independently of each other, so threads do not change the outcome.

    Attributes
    ----------
    n_assignments : int
        Exact k-assignments solved so far.
    """

    def __init__(self, model: RigidModel, threads: int = 1) -> None:
        self.model = model
        self.n_assignments = 0
        self._workers = Workers(threads)

    def evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        """Bound B boxes; candidates are their centres. Above `cutoff` precision is of no use."""
        bounds, values = np.empty(len(lower)), np.empty(len(lower))
        model = self.model

        def work(part: slice) -> int:
            return kernels.bound_boxes(
                lower[part], upper[part], cutoff, model.source, model.target, model.n_inliers,
                bounds[part], values[part],
            )  # fmt: skip

        self.n_assignments += self._workers.run(work, len(lower))
        return Evaluation(bounds, 0.5 * (lower + upper), values)


def search_rigid(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    *,
    gap_tol: float,
    limits: Limits | None = None,
    threads: int = 1,
    listener: Listener | None = None,
    start_box: str = "reduced",
    candidates: np.ndarray | None = None,
) -> RigidResult:
    """Rigid pose that brings `n_inliers` one-to-one pairs closest, globally to `gap_tol`.

    Minimises ``sum p_ij |R x_i + t - y_j|^2`` over proper rotations R, translations t and matchings
    P of exactly `n_inliers` pairs, by best-first branch and bound over the pose.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
        Of about unit size, for the rounding tolerances and the branching.
    n_inliers : int
    gap_tol : float
        Absolute tolerance on ``upper_bound - lower_bound``, in squared units of the points.
    limits : Limits, optional
    threads : int
        The result does not depend on it.
    listener : callable, optional
        Receives every `dcreg.trace.Event` (stage ``rigid``); returning True stops the search.
    start_box : {"reduced", "safe"}
    candidates : (n, m) bool array, optional
        The feasible pairs; `n_inliers` of them must be one to one.

    Returns
    -------
    RigidResult
        Its bounds hold whatever the status.
    """
    began = time.perf_counter()
    limits = limits or Limits()
    centre_x, centre_y = source.mean(axis=0), target.mean(axis=0)
    clouds = [source - centre_x, target - centre_y]
    swapped = len(source) > len(target)
    if swapped:  # the inverse pose has the same residuals
        clouds.reverse()
        candidates = None if candidates is None else candidates.T
    model = RigidModel(
        clouds[0], clouds[1], n_inliers, reduced_box=start_box == "reduced", candidates=candidates
    )
    bound = RigidBound(model, threads)
    theta, value, bound.n_assignments = model.start(limits.time_s)
    spent = time.perf_counter() - began
    found = branch_and_bound(
        bound,
        model.roots(),
        branching=LongestEdge(_AXIS_WEIGHTS),
        gap_tol=gap_tol,
        refine=model.refine,
        start=(theta, value),
        limits=_less_time(limits, spent),
        round_size=int(np.clip(_ROUND_PAIRS // (len(source) * len(target)), 1, 256)),
        listener=listener,
        stage="rigid",
    )
    T = pose(found.theta)
    if swapped:
        T = np.linalg.inv(T)
    T[:3, 3] += centre_y - T[:3, :3] @ centre_x
    return RigidResult(
        T,
        found.lower_bound,
        found.upper_bound,
        found.n_nodes,
        found.n_assignments,
        found.status,
        time.perf_counter() - began,
        SCOPE_FULL,
        found.events,
    )


def pose(theta: np.ndarray) -> np.ndarray:
    """The (4, 4) matrix of a quaternion and a translation."""
    T = np.eye(4)
    T[:3, :3] = RotationModel.matrix(theta[:4])
    T[:3, 3] = theta[4:]
    return T


def _less_time(limits: Limits, spent: float) -> Limits:
    if limits.time_s is None:
        return limits
    return dataclasses.replace(limits, time_s=max(0.0, limits.time_s - spent))


@dataclass(frozen=True)
class Basin:
    """A distinct low place of the norm objective, and what the rotation search made of it.

    Attributes
    ----------
    translation : (3,) array
        t of x + t: a local minimiser, or that of the best pose of a grid.
    norm_value : float
        The norm objective there.
    T : (4, 4) array
        The refined pose from this translation.
    value : float
        The rigid objective at `T`.
    """

    translation: np.ndarray
    norm_value: float
    T: np.ndarray
    value: float


@dataclass(frozen=True)
class MultiResult(RigidResult):
    """`RigidResult` whose bounds are those of the norm objective.

    Attributes
    ----------
    value : float
        The rigid objective at `T`.
    basins : list of Basin
        Best rigid objective first.
    complete : bool
        Whether every translation within the margin was looked at; if not, only the lowest found.
    """

    value: float = np.inf
    basins: list[Basin] = field(default_factory=list)
    complete: bool = False


class _Collector:
    """Descents in norm space, each end remembered."""

    def __init__(self, model: Translation3D) -> None:
        self.model = model
        self.ends: list[tuple[float, np.ndarray]] = []
        self.spent = 0

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        theta, value, spent = self.model.refine(theta)
        self.ends.append((value, theta))
        self.spent += spent
        return theta, value, spent

    def distinct(self, cutoff: float, separation: float, count: int) -> list[np.ndarray]:
        """Up to `count` ends at or below `cutoff`, lowest first, `separation` apart."""
        kept: list[np.ndarray] = []
        for value, theta in sorted(self.ends, key=lambda end: end[0]):
            if value > cutoff or len(kept) == count:
                break
            if all(np.linalg.norm(theta - other) > separation for other in kept):
                kept.append(theta)
        return kept


def _low_boxes(
    bound: object, root: Box, cutoff: float, width: float, node_limit: int, until: float | None
) -> tuple[np.ndarray, bool]:
    """Centres of boxes at most `width` wide that together hold every theta below `cutoff`.

    Second is False where a limit ended the division early: then boxes are missing.
    """
    branching = LongestEdge(np.ones(root.dim))
    stack = [(root.lower[None], root.upper[None])]
    leaves: list[np.ndarray] = []
    n_nodes = 0
    while stack:
        if n_nodes >= node_limit or (until is not None and time.perf_counter() > until):
            return np.concatenate([*leaves, np.empty((0, root.dim))]), False
        lower, upper = stack.pop()
        found = bound.evaluate(lower, upper, cutoff)  # type: ignore[attr-defined]
        n_nodes += len(lower)
        low = found.lower_bounds < cutoff
        fine = low & ((upper - lower).max(axis=1) <= width)
        leaves.append(0.5 * (lower + upper)[fine])
        lower, upper = lower[low & ~fine], upper[low & ~fine]
        stack += [
            branching(lower[at : at + 16], upper[at : at + 16]) for at in range(0, len(lower), 16)
        ]
    return np.concatenate(leaves), True


def search_multi(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    *,
    gap_tol: float,
    limits: Limits | None = None,
    threads: int = 1,
    listener: Listener | None = None,
    start_box: str = "reduced",
    candidates: np.ndarray | None = None,
    bound: str = "paper",
    margin: float | None = None,
    separation: float = 0.1,
    max_basins: int = 12,
    basin_nodes: int = 20_000,
) -> MultiResult:
    """The paper's two stages over several translations: the best rigid objective wins.

    First the best of descents from a grid of poses, as in mode `full`. Then the translation in norm
    space, certified to `gap_tol`, and every box of translations whose norm objective may lie within
    `margin` of its optimum, each giving a descent; the distinct ends, and the translation that joins
    the centroids, go through a rotation search, as far as it may still better the best pose, and a
    joint refinement of matching and pose. The certificate is that of the norm objective alone: it
    says nothing of the rotation, nor that the best pose is the best of all.

    Parameters
    ----------
    source, target, n_inliers, gap_tol, limits, threads, listener, start_box, candidates
        As in `search_rigid`; `gap_tol` is that of the norm objective. ``limits.time_s`` is for all
        stages, the other limits for each.
    bound : str
        Bounding function of the norm objective, see `dcreg.bounds`.
    margin : float, optional
        Translations with a norm objective this far above the best count; default `gap_tol`.
    separation : float
        Translations closer than this are one basin, in units of the points.
    max_basins : int
        Rotation searches made at most.
    basin_nodes : int
        Boxes spent on the enumeration of the basins.

    Returns
    -------
    MultiResult
    """
    began = time.perf_counter()
    limits = limits or Limits()
    margin = gap_tol if margin is None else margin
    model = Translation3D(
        source, target, n_inliers, reduced_box=start_box == "reduced", candidates=candidates
    )
    basins = [_first_basin(model, candidates, limits.time_s and 0.25 * limits.time_s)]
    bounding = make_bound(bound, model, threads)
    descents = _Collector(model)
    left = _less_time(limits, time.perf_counter() - began)
    found = _search_norm(model, bounding, descents, gap_tol, left, listener)
    # half of what is left for finding basins, the rest for their rotations
    time_s = _less_time(limits, time.perf_counter() - began).time_s
    until = None if time_s is None else time.perf_counter() + 0.5 * time_s
    cutoff = found.upper_bound + margin
    centres, complete = _low_boxes(
        bounding, model.start_box(), cutoff, separation, basin_nodes, until
    )
    for theta in centres[:: max(1, -(-len(centres) // _NORM_DESCENTS))]:
        if until is not None and time.perf_counter() > until:
            complete = False
            break
        descents.refine(theta)
    translations = [
        *descents.distinct(cutoff, separation, max_basins),
        target.mean(axis=0) - source.mean(axis=0),
    ]
    complete = complete and len(translations) <= max_basins and len(centres) <= _NORM_DESCENTS
    rigid = RigidModel(source, target, n_inliers, candidates=candidates)
    n_nodes, status = found.n_nodes, found.status
    n_assignments = bounding.n_assignments + descents.spent
    for done, translation in enumerate(translations):
        best = min(basin.value for basin in basins)
        norm_value = model.objective(translation)[0]
        # a pose within half a `separation` of this translation and better than the best has, at this
        # very translation, an objective below `worth`
        worth = (np.sqrt(best) + 0.5 * separation * np.sqrt(n_inliers)) ** 2
        if norm_value >= worth:
            continue
        time_s = _less_time(limits, time.perf_counter() - began).time_s
        if time_s == 0.0:
            status = Status.TIME_LIMIT if status is Status.OPTIMAL else status
            complete = False
            break
        time_s = None if time_s is None else time_s / (len(translations) - done)
        turned = _turn(
            RotationModel(source + translation, target, n_inliers, candidates),
            worth, gap_tol, Limits(time_s, limits.nodes), listener,
        )  # fmt: skip
        rotation = RotationModel.matrix(turned.theta)
        theta, value, spent = rigid.refine(_theta(rotation, translation))
        basins.append(Basin(translation, norm_value, pose(theta), value))
        n_nodes += turned.n_nodes
        n_assignments += turned.n_assignments + spent
        if turned.status is Status.STOPPED:
            status = turned.status
            break
        if status is Status.OPTIMAL:
            status = turned.status
    basins.sort(key=lambda basin: basin.value)
    return MultiResult(
        basins[0].T,
        found.lower_bound,
        found.upper_bound,
        n_nodes,
        n_assignments,
        status,
        time.perf_counter() - began,
        SCOPE_MULTI,
        found.events,
        basins[0].value,
        basins,
        complete,
    )


def _first_basin(
    norms: Translation3D, candidates: np.ndarray | None, time_limit: float | None
) -> Basin:
    """The best of descents from a grid of poses: where every search for the pose may start."""
    source, target = norms.source, norms.target
    centre_x, centre_y = source.mean(axis=0), target.mean(axis=0)
    theta, value, _ = RigidModel(
        source - centre_x, target - centre_y, norms.n_inliers, candidates=candidates
    ).start(time_limit)
    T = pose(theta)
    T[:3, 3] += centre_y - T[:3, :3] @ centre_x
    translation = T[:3, :3].T @ T[:3, 3]
    return Basin(translation, norms.objective(translation)[0], T, value)


def _turn(
    model: RotationModel,
    worth: float,
    gap_tol: float,
    limits: Limits,
    listener: Listener | None,
) -> SearchResult:
    """Search the rotations with an objective below `worth`.

    Its rotation is where a joint descent starts, so it need not be the best one to `gap_tol`.
    """
    began = time.perf_counter()
    bound = RotationBound(model)
    theta, value, bound.n_assignments = model.start(limits.time_s)
    value = min(value, worth)
    return branch_and_bound(
        bound,
        model.roots(),
        branching=LongestEdge(np.ones(4)),
        gap_tol=max(gap_tol, _BASIN_GAP * value),
        refine=model.refine,
        start=(theta, value),
        limits=_less_time(limits, time.perf_counter() - began),
        round_size=32,
        listener=listener,
        stage="basin",
    )


def _search_norm(
    model: Translation3D,
    bound: object,
    descents: _Collector,
    gap_tol: float,
    limits: Limits,
    listener: Listener | None,
) -> SearchResult:
    theta, value, _ = descents.refine(model.identity)
    time_s = limits.time_s and 0.5 * limits.time_s
    return branch_and_bound(
        bound,  # type: ignore[arg-type]
        [model.start_box()],
        branching=LongestEdge(model.axis_weights),
        gap_tol=gap_tol,
        refine=descents.refine,
        start=(theta, value),
        limits=dataclasses.replace(limits, time_s=time_s),
        listener=listener,
    )


def _theta(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Parameters of y = R (x + t), by the fit to four moved points."""
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    theta = np.empty(7)
    moved = (corners + translation) @ rotation.T
    kernels.fit_rigid(
        np.ascontiguousarray(corners.T), np.ascontiguousarray(moved.T), np.arange(4), theta
    )
    return theta
