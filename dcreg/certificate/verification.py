"""Check a certificate in plain NumPy and SciPy, without the code that searched for it.

Nothing here uses the library's search, bounds, models or kernels: a mistake there cannot hide itself. The
checks, in order: the file is whole and speaks of these clouds; its start box holds every optimum; its
leaves tile the start box; the stated optimum is attained; no sampled parameter beats its leaf; and every
leaf's bound is proven anew, by interval and tangent bounds on the leaf or, where those fall short, on
parts of it.
"""

from __future__ import annotations

import abc
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from dcreg.certificate.format import (
    INADMISSIBLE,
    PRUNED,
    Certificate,
    CertificateError,
    digest,
    read,
)

BATCH = 64  # boxes treated at once: bounds the memory of the vectorised steps
MAX_DENSE = 4_000_000  # pairs of which cost matrices are formed
SAME = 1e-12  # coordinates closer than this share of the start box are the same


@dataclass
class Report:
    """What `verify` found. Bounds are in squared units of the target, as in `dcreg.Result`.

    Attributes
    ----------
    accepted : bool
    reason : str
        Why the certificate was refused; empty if it was accepted.
    statement : str
        What is now known to hold; empty if refused.
    checks : list of str
        One line per check that was passed.
    n_leaves, n_boxes, n_assignments : int
        Leaves of the file, boxes they had to be cut into for the proof, assignments solved.
    """

    accepted: bool = False
    reason: str = ""
    statement: str = ""
    checks: list[str] = field(default_factory=list)
    model: str = ""
    n_inliers: int = 0
    lower_bound: float = np.nan
    upper_bound: float = np.nan
    gap_tol: float = np.nan
    n_leaves: int = 0
    n_boxes: int = 0
    n_assignments: int = 0
    time_s: float = 0.0


def verify(
    path: str | Path,
    source: np.ndarray,
    target: np.ndarray,
    *,
    max_boxes: int | None = None,
    n_samples: int = 500,
) -> Report:
    """Check the certificate in `path` against the clouds it should speak of.

    Parameters
    ----------
    path : path
        Written by `dcreg.certificate.write`.
    source, target : (n, d), (m, d) arrays
        As they were given to `dcreg.register`.
    max_boxes : int, optional
        Boxes to be bounded before the proof counts as failed; default 1000 plus 20 per leaf.
    n_samples : int
        Random parameters tried against the leaf bounds.

    Returns
    -------
    Report
        Never raises for a bad certificate: it is refused, with the reason.
    """
    began = time.perf_counter()
    report = Report()
    try:
        _verify(report, read(path), source, target, max_boxes, n_samples)
        report.accepted = True
    except CertificateError as error:
        report.reason = str(error)
    report.time_s = time.perf_counter() - began
    return report


def _verify(
    report: Report,
    c: Certificate,
    source: np.ndarray,
    target: np.ndarray,
    max_boxes: int | None,
    n_samples: int,
) -> None:
    report.checks.append(f"complete and unchanged: {len(c.leaf_bounds)} leaves, sealed")
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    for name, points, stated in (
        ("source", source, c.source_digest),
        ("target", target, c.target_digest),
    ):
        if digest(points) != stated:
            raise CertificateError(f"{name}: other data than the certificate was made for")
    if c.n_inliers > min(len(source), len(target)):
        raise CertificateError(f"n_inliers: {c.n_inliers} exceeds the smaller cloud")
    report.checks.append(f"made for these clouds: {len(source)} and {len(target)} points")

    area = c.unit**2
    report.model, report.n_inliers, report.n_leaves = c.model, c.n_inliers, len(c.leaf_bounds)
    report.lower_bound, report.upper_bound = c.lower_bound * area, c.upper_bound * area
    report.gap_tol = c.gap_tol * area

    is_dense = len(source) * len(target) <= MAX_DENSE
    problem = FAMILIES[c.model](
        (source - c.source_centre) / c.unit,
        (target - c.target_centre) / c.unit,
        c.n_inliers,
        tuple(c.scale_range),
        feasible_pairs(c, len(source), len(target)) if is_dense else None,
    )
    if not is_dense and (len(c.candidates) or not problem.is_sorted_order):
        raise CertificateError(
            f"cannot be checked: {len(source)} x {len(target)} pairs exceed {MAX_DENSE:,}"
        )
    # rounding: relative to the claim, and to a residual of the size of the cloud
    slack = 1e-9 * abs(c.upper_bound) + 1e-12 * c.n_inliers
    check_claim(c, slack)
    report.checks.append("stated bounds, reasons and tolerance agree with each other")
    check_start_box(problem, c.start_lower, c.start_upper)
    report.checks.append("the start box holds every optimum")
    check_cover(c.start_lower, c.start_upper, c.leaf_lower, c.leaf_upper)
    report.checks.append("the leaves tile the start box")
    try:
        check_optimum(problem, c, slack)
        report.checks.append(f"the stated parameter attains {report.upper_bound:.9g}")
        tried = check_samples(problem, c, slack, n_samples)
        report.checks.append(f"none of {tried} sampled parameters beats its leaf")
        proof = Proof(problem, slack, max_boxes or 1000 + 20 * len(c.leaf_bounds))
        report.n_boxes = proof.run(c)
    finally:
        report.n_assignments = problem.n_assignments
    report.checks.append(f"every leaf's bound holds, proven on {report.n_boxes} boxes")
    among = f" among {len(c.candidates)} candidates" if len(c.candidates) else ""
    report.statement = (
        f"{SCOPES[c.model]}: the least sum over {c.n_inliers} one-to-one pairs{among} of squared "
        f"residuals lies in [{report.lower_bound:.9g}, {report.upper_bound:.9g}]"
    )


def feasible_pairs(c: Certificate, n: int, m: int) -> np.ndarray | None:
    """(n, m) mask of the candidates, None where every pair is feasible."""
    if not len(c.candidates):
        return None
    if (c.candidates >= (n, m)).any():
        raise CertificateError("candidates: an index beyond the clouds")
    mask = np.zeros((n, m), dtype=bool)
    mask[tuple(c.candidates.T)] = True
    if (maximum_bipartite_matching(csr_array(mask)) >= 0).sum() < c.n_inliers:
        raise CertificateError(f"candidates: no {c.n_inliers} of them are one to one")
    return mask


# --- the statement ----------------------------------------------------------------------------


def check_claim(c: Certificate, slack: float) -> None:
    """The leaves' bounds, if true, imply the stated lower bound, and the status follows."""
    if not 0 <= c.lower_bound <= c.upper_bound + slack:
        raise CertificateError(
            f"lower_bound {c.lower_bound:.9g} does not lie in [0, upper_bound {c.upper_bound:.9g}]"
        )
    least = c.leaf_bounds.min()
    if c.lower_bound > least + slack:
        raise CertificateError(
            f"lower_bound {c.lower_bound:.9g} does not follow: leaf {int(c.leaf_bounds.argmin())} "
            f"has the bound {least:.9g}"
        )
    threshold = c.upper_bound - c.gap_tol - slack
    if c.status == "optimal" and c.lower_bound < threshold:
        raise CertificateError("status optimal does not follow: the gap exceeds gap_tol")
    early = np.flatnonzero((c.leaf_reasons == PRUNED) & (c.leaf_bounds < threshold))
    if early.size:
        raise CertificateError(
            f"leaf {early[0]} was pruned with the bound {c.leaf_bounds[early[0]]:.9g}, "
            f"below upper_bound - gap_tol = {c.upper_bound - c.gap_tol:.9g}"
        )


def check_start_box(problem: Family, lower: np.ndarray, upper: np.ndarray) -> None:
    """No optimum lies outside of the start box, by a region computed here."""
    need_lower, need_upper = problem.region()
    tolerance = 1e-9 * (1.0 + np.abs(need_upper) + np.abs(need_lower))
    short = np.flatnonzero((lower > need_lower + tolerance) | (upper < need_upper - tolerance))
    if short.size:
        axis = short[0]
        raise CertificateError(
            f"start box: axis {axis} spans [{lower[axis]:.9g}, {upper[axis]:.9g}], but an optimum "
            f"may lie anywhere in [{need_lower[axis]:.9g}, {need_upper[axis]:.9g}]"
        )


def check_cover(
    start_lower: np.ndarray, start_upper: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> None:
    """The leaves tile the start box: cut it between leaves until each part is one leaf.

    Every tiling that bisection makes can be taken apart so. A part that no plane divides holds
    overlapping leaves; a part with one leaf that does not fill it has a gap.
    """
    if not (lower <= upper).all():
        raise CertificateError(f"leaf {np.argmin((lower <= upper).all(axis=1))} is not a box")
    low, high, first, last, places = _as_integers(start_lower, start_upper, lower, upper)
    wide = np.flatnonzero(first < last)  # a plane across a flat axis would divide nothing
    parts = [(first, last, np.arange(len(low)))]
    while parts:
        first, last, leaves = parts.pop()
        if len(leaves) == 1:
            leaf = leaves[0]
            if (low[leaf] != first).any() or (high[leaf] != last).any():
                raise CertificateError(
                    f"leaves: a gap, or a part outside of the start box, next to leaf {leaf}"
                )
            continue
        axis, cut, left, right = _cut(low, high, leaves, places, wide)
        middle_last, middle_first = last.copy(), first.copy()
        middle_last[axis] = middle_first[axis] = cut
        parts += [(first, middle_last, left), (middle_first, last, right)]


def _as_integers(
    start_lower: np.ndarray, start_upper: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Coordinates as ranks of the distinct ones per axis; rounding differences vanish."""
    low, high = np.empty(lower.shape, np.int64), np.empty(lower.shape, np.int64)
    first, last = np.empty(len(start_lower), np.int64), np.empty(len(start_lower), np.int64)
    places = []
    for axis in range(len(start_lower)):
        ends = np.array([start_lower[axis], start_upper[axis]])
        values = np.unique(np.concatenate([lower[:, axis], upper[:, axis], ends]))
        tolerance = SAME * (ends[1] - ends[0] or max(1.0, abs(ends[0])))
        rank = np.concatenate([[0], np.cumsum(np.diff(values) > tolerance)])
        for out, numbers in ((low[:, axis], lower[:, axis]), (high[:, axis], upper[:, axis])):
            out[:] = rank[np.searchsorted(values, numbers)]
        first[axis], last[axis] = rank[np.searchsorted(values, ends)]
        places.append(values[np.concatenate([[True], np.diff(rank) > 0])])
    return low, high, first, last, places


def _cut(
    low: np.ndarray,
    high: np.ndarray,
    leaves: np.ndarray,
    places: list[np.ndarray],
    axes: np.ndarray,
) -> tuple[int, int, np.ndarray, np.ndarray]:
    """The plane between leaves nearest to the middle of its axis, and the leaves on either side."""
    best: tuple | None = None
    for axis in axes:
        order = leaves[np.argsort(low[leaves, axis], kind="stable")]
        reach = np.maximum.accumulate(high[order, axis])
        free = np.flatnonzero(low[order[1:], axis] >= reach[:-1])
        if not free.size:
            continue
        begin, end = places[axis][low[order[0], axis]], places[axis][reach[-1]]
        off = np.abs(places[axis][reach[free]] - 0.5 * (begin + end)) / (end - begin or 1.0)
        at = int(np.argmin(off))
        if best is None or off[at] < best[0]:
            split = free[at] + 1
            best = (off[at], axis, reach[free[at]], order[:split], order[split:])
        if best[0] == 0.0:
            break
    if best is None:
        raise CertificateError(f"leaves: {leaves[0]} and {leaves[1]} or others near them overlap")
    return best[1:]


# --- the values -------------------------------------------------------------------------------


def check_optimum(problem: Family, c: Certificate, slack: float) -> None:
    """`theta` is a pose of the family and its objective is the stated upper bound."""
    if not problem.admissible(c.theta[None])[0]:
        raise CertificateError("theta: not an admissible parameter")
    value = problem.objective(c.theta)
    if abs(value - c.upper_bound) > slack:
        raise CertificateError(
            f"upper_bound: {c.upper_bound:.9g} stated, but the objective at theta is {value:.9g}"
        )


def check_samples(problem: Family, c: Certificate, slack: float, n_samples: int) -> int:
    """No random parameter of a random leaf has an objective below the leaf's bound."""
    generator = np.random.default_rng(0)
    leaves = generator.integers(len(c.leaf_bounds), size=n_samples)
    share = generator.random((n_samples, c.leaf_lower.shape[1]))
    thetas = c.leaf_lower[leaves] + share * (c.leaf_upper - c.leaf_lower)[leaves]
    admissible = np.flatnonzero(problem.admissible(thetas))
    for at in admissible:
        leaf = leaves[at]
        problem.refute(thetas[at], c.leaf_bounds[leaf] - slack, f"leaf {leaf}")
    return len(admissible)


class Proof:
    """Proves lower bounds on boxes, dividing those on which the plain bounds fall short."""

    def __init__(self, problem: Family, slack: float, max_boxes: int) -> None:
        self.problem = problem
        self.slack = slack
        self.max_boxes = max_boxes

    def run(self, c: Certificate) -> int:
        """Prove every leaf's bound; the number of boxes that took."""
        leaves = np.arange(len(c.leaf_bounds))
        lower, upper = c.leaf_lower, c.leaf_upper
        n_boxes = 0
        while len(leaves):
            n_boxes += len(leaves)
            if n_boxes > self.max_boxes:
                raise CertificateError(
                    f"leaf {leaves[0]}: its bound {c.leaf_bounds[leaves[0]]:.9g} could not be "
                    f"confirmed within {self.max_boxes} boxes"
                )
            missing = np.concatenate(
                [
                    at + self._unproven(lower[part], upper[part], leaves[part], c)
                    for at in range(0, len(leaves), BATCH)
                    for part in [slice(at, at + BATCH)]
                ]
            )
            stuck = missing[c.leaf_reasons[leaves[missing]] == INADMISSIBLE]
            if stuck.size:
                raise CertificateError(
                    f"leaf {leaves[stuck[0]]} is stated to hold no admissible parameter, but may"
                )
            leaves = np.repeat(leaves[missing], 2)
            lower, upper = self._halves(lower[missing], upper[missing])
        return n_boxes

    def _unproven(
        self, lower: np.ndarray, upper: np.ndarray, leaves: np.ndarray, c: Certificate
    ) -> np.ndarray:
        """Indices of the boxes whose leaf's bound cannot be proven on them; cheap bounds first."""
        problem = self.problem
        needed = c.leaf_bounds[leaves] - self.slack
        # a sum of squares is never negative
        open_ = np.flatnonzero((needed > 0) & ~problem.outside(lower, upper))
        for bound in (problem.nearest_bound, self._tangent_bound, problem.interval_bound):
            if open_.size:
                found = bound(lower[open_], upper[open_], needed[open_])
                open_ = open_[found < needed[open_]]
        for box in open_:
            for theta in (lower[box], upper[box], 0.5 * (lower[box] + upper[box])):
                if problem.admissible(theta[None])[0]:
                    problem.refute(theta, needed[box], f"leaf {leaves[box]}")
        return open_

    def _tangent_bound(
        self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray
    ) -> np.ndarray:
        """max over theta0 of min over vertices v of ``E(v) - G(v - theta0)``.

        The objective of one matching is convex minus convex. With its convex part replaced by the
        tangent at any theta0, it is concave and so least at a vertex, where exactly
        ``sum p_ij R_i(v - theta0)`` is lost, at most the k largest R_i: G. theta0 moves towards the
        vertex that is least at present.
        """
        problem = self.problem
        vertices = _vertices(lower, upper)
        known = np.array([[problem.known(v) for v in box] for box in vertices])
        values, exact = known[..., 0], known[..., 1] > 0
        best, losses = np.full(len(lower), -np.inf), np.empty(values.shape)
        bases = np.empty(lower.shape)
        open_ = np.arange(len(lower))
        while open_.size:
            best[open_], bases[open_] = self._best_base(
                vertices[open_], values[open_], needed[open_]
            )
            open_ = open_[best[open_] < needed[open_]]
            losses[open_] = problem.most_missed(vertices[open_] - bases[open_, None])
            # only vertices that hold a box back need their exact value
            binding = (values[open_] - losses[open_] < needed[open_, None]) & ~exact[open_]
            for box, at in zip(open_[binding.nonzero()[0]], binding.nonzero()[1], strict=True):
                values[box, at] = problem.cached_objective(vertices[box, at])
                exact[box, at] = True
            open_ = open_[binding.any(axis=1)]
        for box in np.flatnonzero(best < needed):
            best[box] = problem.exact_tangent_bound(
                vertices[box], values[box], bases[box], needed[box]
            )
        return best

    def _best_base(
        self, vertices: np.ndarray, values: np.ndarray, needed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best bound found and where to linearise for it; stops once all boxes are proven."""
        boxes = np.arange(len(vertices))
        base = vertices.mean(axis=1)
        best, best_base = np.full(len(vertices), -np.inf), base.copy()
        for step in range(30):
            at_vertices = values - self.problem.most_missed(vertices - base[:, None])
            least = at_vertices.argmin(axis=1)
            found = at_vertices[boxes, least]
            better = found > best
            best[better], best_base[better] = found[better], base[better]
            if (best >= needed).all():
                break
            base += (vertices[boxes, least] - base) / (step + 2)
        return best, best_base

    def _halves(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bisect every box along its longest edge, measured by the residual it causes."""
        axis = np.argmax((upper - lower) * self.problem.weights, axis=1)
        lower, upper = np.repeat(lower, 2, axis=0), np.repeat(upper, 2, axis=0)
        rows = np.arange(len(axis))
        middle = 0.5 * (lower[2 * rows, axis] + upper[2 * rows, axis])
        upper[2 * rows, axis] = middle
        lower[2 * rows + 1, axis] = middle
        return lower, upper


def _vertices(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """(B, V, d) corners, without repeating those of axes that are flat in all boxes."""
    wide = np.flatnonzero((upper > lower).any(axis=0))
    bits = (np.arange(2 ** len(wide))[:, None] >> np.arange(len(wide))) & 1
    out = np.repeat(lower[:, None, :], len(bits), axis=1)
    out[:, :, wide] = np.where(bits, upper[:, None, wide], lower[:, None, wide])
    return out


# --- the models -------------------------------------------------------------------------------


def cheapest_pairs(cost: np.ndarray, k: int) -> float:
    """The k cheapest pairs, one per row and column, of costs that are not negative."""
    cost = cost if cost.shape[0] <= cost.shape[1] else cost.T
    idle = cost.shape[0] - k
    if idle:  # that many rows are best matched with free dummies
        cost = np.hstack([cost, np.zeros((cost.shape[0], idle))])
    rows, columns = linear_sum_assignment(cost)
    return float(cost[rows, columns].sum())


def sum_of_smallest(values: np.ndarray, k: int) -> np.ndarray:
    """Sum of the k smallest along the last axis."""
    if k == values.shape[-1]:
        return values.sum(axis=-1)
    return np.partition(values, k - 1, axis=-1)[..., :k].sum(axis=-1)


class Family(abc.ABC):
    """A model's objective ``E(theta)``: the k cheapest pairs of squared feature distances."""

    weights: np.ndarray
    is_sorted_order = False  # the best matching is known without a cost matrix

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        k: int,
        scale_range: tuple[float, float],
        feasible: np.ndarray | None = None,
    ) -> None:
        self.feasible = feasible
        self.source = source
        self.target = target
        self.k = k
        self.scale_range = scale_range
        self.n_assignments = 0
        self._known: dict[bytes, tuple[float, bool]] = {}
        self.prepare()

    @abc.abstractmethod
    def prepare(self) -> None:
        """Set `weights` and whatever the model computes once."""

    @abc.abstractmethod
    def objective(self, theta: np.ndarray) -> float: ...

    @abc.abstractmethod
    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box outside of which no optimum lies."""

    @abc.abstractmethod
    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """Every source point at its own best place in the box, with its nearest target."""

    @abc.abstractmethod
    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """(n, m) least squared distances over one box; None where too large to be formed."""

    @abc.abstractmethod
    def most_missed(self, delta: np.ndarray) -> np.ndarray:
        """G(delta), at least the sum of the k largest R_i(delta), over the last axis."""

    def exact_tangent_bound(
        self, vertices: np.ndarray, values: np.ndarray, base: np.ndarray, needed: float
    ) -> float:
        """The tangent bound of one box with the matching chosen for the tangent, where it helps."""
        return float((values - self.most_missed(vertices - base)).min())

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        return np.ones(len(thetas), dtype=bool)

    def outside(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Boxes without an admissible parameter."""
        return np.zeros(len(lower), dtype=bool)

    def interval_bound(
        self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray
    ) -> np.ndarray:
        """Every pair at its own best place in the box, matched one-to-one."""
        out = np.zeros(len(lower))
        for box in range(len(lower)):
            cost = self.interval_costs(lower[box], upper[box])
            if cost is not None:
                out[box] = self.match(cost)
        return out

    def match(self, cost: np.ndarray) -> float:
        """The k cheapest feasible pairs; costs are not negative."""
        self.n_assignments += 1
        if self.feasible is not None:  # another pair is dearer than k feasible ones
            cost = np.where(self.feasible, cost, 1.0 + self.k * cost.max())
        return cheapest_pairs(cost, self.k)

    def known(self, theta: np.ndarray) -> tuple[float, bool]:
        """A lower bound on the objective at a vertex and whether it is exact; leaves share them."""
        key = theta.tobytes()
        if key not in self._known:
            self._known[key] = self.estimate(theta)
        return self._known[key]

    def estimate(self, theta: np.ndarray) -> tuple[float, bool]:
        """A cheap lower bound on the objective, and whether it is exact."""
        return float(self.nearest_bound(theta[None], theta[None], np.array([np.inf]))[0]), False

    def cached_objective(self, theta: np.ndarray) -> float:
        key = theta.tobytes()
        if not self._known.get(key, (0.0, False))[1]:
            self._known[key] = self.objective(theta), True
        return self._known[key][0]

    def refute(self, theta: np.ndarray, needed: float, what: str) -> None:
        value = self.cached_objective(theta)
        if value < needed:
            raise CertificateError(
                f"{what}: its bound is false: theta {np.array2string(theta, precision=6)} "
                f"has the objective {value:.9g}, below {needed:.9g}"
            )


class Similarity2D(Family):
    """theta = (a, b, u, v) moves x, as a complex number, to ``(a + ib) x + (u + iv)``."""

    def prepare(self) -> None:
        self.z = self.source[:, 0] + 1j * self.source[:, 1]
        spread = np.sqrt((self.source**2).sum(axis=1).mean())
        self.weights = np.array([spread, spread, 1.0, 1.0])

    def objective(self, theta: np.ndarray) -> float:
        return self.match(self._costs(theta))

    def _costs(self, theta: np.ndarray) -> np.ndarray:
        moved = (theta[0] + 1j * theta[1]) * self.z + (theta[2] + 1j * theta[3])
        dx = moved.real[:, None] - self.target[:, 0]
        dy = moved.imag[:, None] - self.target[:, 1]
        return dx * dx + dy * dy

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """The best translation is (mean of matched y) - s R (mean of matched x)."""
        high = self.scale_range[1]
        # |mean of k points| <= its largest projection on N directions / cos(pi / N), for any N
        reach = np.inf
        for count in (64, 1024):
            angle = 2 * np.pi / count * np.arange(count)
            projected = self.source @ np.array([np.cos(angle), np.sin(angle)])
            means = -sum_of_smallest(-projected.T, self.k) / self.k
            reach = min(reach, high * max(means.max(), 0.0) / np.cos(np.pi / count))
        low_y = sum_of_smallest(self.target.T, self.k) / self.k
        high_y = -sum_of_smallest(-self.target.T, self.k) / self.k
        return (
            np.concatenate([[-high, -high], low_y - reach]),
            np.concatenate([[high, high], high_y + reach]),
        )

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        scale = np.hypot(thetas[:, 0], thetas[:, 1])
        return (scale >= low * (1 - 1e-12)) & (scale <= high * (1 + 1e-12))

    def outside(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        lower, upper = lower[:, :2], upper[:, :2]
        nearest = np.linalg.norm(np.clip(0.0, lower, upper), axis=1)
        farthest = np.linalg.norm(np.maximum(np.abs(lower), np.abs(upper)), axis=1)
        return (nearest > high) | (farthest < low)

    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        moved = (centre[0] + 1j * centre[1]) * self.z + (centre[2] + 1j * centre[3])
        x, y = np.abs(self.source.T)
        half_x, half_y = half[0] * x + half[1] * y + half[2], half[0] * y + half[1] * x + half[3]
        dx = np.abs(moved.real[:, None] - self.target[:, 0]) - half_x[:, None]
        dy = np.abs(moved.imag[:, None] - self.target[:, 1]) - half_y[:, None]
        return np.maximum(dx, 0.0) ** 2 + np.maximum(dy, 0.0) ** 2

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        out = np.empty(len(lower))
        for box in range(len(lower)):
            cost = self.interval_costs(lower[box], upper[box])
            out[box] = sum_of_smallest(cost.min(axis=1), self.k)
            if out[box] < needed[box]:
                out[box] = max(out[box], sum_of_smallest(cost.min(axis=0), self.k))
        return out

    def most_missed(self, delta: np.ndarray) -> np.ndarray:
        turn, shift = delta[..., 0] + 1j * delta[..., 1], delta[..., 2] + 1j * delta[..., 3]
        if self.k == len(self.z):  # the sum over all points, expanded
            size = (np.abs(self.z) ** 2).sum()
            cross = (np.conj(shift) * turn * self.z.sum()).real
            return np.abs(turn) ** 2 * size + 2 * cross + self.k * np.abs(shift) ** 2
        return -sum_of_smallest(-self._missed(turn, shift), self.k)

    def _missed(self, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """R_i = |turn x_i + shift|^2, real arithmetic for speed."""
        x, y = self.source.T
        u = turn.real[..., None] * x - turn.imag[..., None] * y + shift.real[..., None]
        v = turn.imag[..., None] * x + turn.real[..., None] * y + shift.imag[..., None]
        return u * u + v * v

    def exact_tangent_bound(
        self, vertices: np.ndarray, values: np.ndarray, base: np.ndarray, needed: float
    ) -> float:
        """When some points stay unmatched, those with the largest R_i need not be matched ones."""
        delta = vertices - base
        bounds = values - self.most_missed(delta)
        if self.k == len(self.z):
            return float(bounds.min())
        missed = self._missed(delta[:, 0] + 1j * delta[:, 1], delta[:, 2] + 1j * delta[:, 3])
        for at in np.argsort(bounds):
            if bounds[at] >= needed:
                break
            # shifted to be non-negative; exactly k pairs are shifted
            most = missed[at].max()
            cost = self._costs(vertices[at]) + (most - missed[at])[:, None]
            bounds[at] = self.match(cost) - self.k * most
            if bounds[at] < needed:  # this box has to be divided anyway
                break
        return float(bounds.min())


class Translation3D(Family):
    """theta = t; matched are the norms ``|x + t|`` and ``|y|``."""

    def prepare(self) -> None:
        self.norms = np.linalg.norm(self.target, axis=1)
        self.sorted_norms = np.sort(self.norms)
        self.weights = np.ones(3)
        n, m = len(self.source), len(self.target)
        self.is_sorted_order = self.feasible is None and n == m == self.k  # on a line

    def objective(self, theta: np.ndarray) -> float:
        moved = np.linalg.norm(self.source + theta, axis=1)
        if self.is_sorted_order:
            return float(((np.sort(moved) - self.sorted_norms) ** 2).sum())
        return self.match((moved[:, None] - self.norms) ** 2)

    def estimate(self, theta: np.ndarray) -> tuple[float, bool]:
        if self.is_sorted_order:
            return self.objective(theta), True
        return super().estimate(theta)

    def region(self) -> tuple[np.ndarray, np.ndarray]:
        """A minimiser is stationary: t is the mean of |y| u - x over the pairs, u unit vectors."""
        reach = -sum_of_smallest(-self.norms, self.k) / self.k
        low_x = sum_of_smallest(self.source.T, self.k) / self.k
        high_x = -sum_of_smallest(-self.source.T, self.k) / self.k
        return -reach - high_x, reach - low_x

    def _intervals(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest |x + t| over boxes (..., 3)."""
        low, high = self.source + lower[..., None, :], self.source + upper[..., None, :]
        near = np.linalg.norm(np.clip(0.0, low, high), axis=-1)
        return near, np.linalg.norm(np.maximum(np.abs(low), np.abs(high)), axis=-1)

    def interval_costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        if len(self.source) * len(self.norms) > MAX_DENSE:
            return None
        near, far = self._intervals(lower, upper)
        outside = np.maximum(near[:, None] - self.norms, self.norms - far[:, None])
        return np.maximum(outside, 0.0) ** 2

    def nearest_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        near, far = self._intervals(lower, upper)
        edges = np.concatenate([[-np.inf], self.sorted_norms, [np.inf]])
        # the first norm at or above the interval's near end, and the last one before it
        at = np.searchsorted(self.sorted_norms, near)
        distance = np.minimum(near - edges[at], np.maximum(edges[at + 1] - far, 0.0))
        return sum_of_smallest(distance**2, self.k)

    def most_missed(self, delta: np.ndarray) -> np.ndarray:
        return self.k * (delta**2).sum(axis=-1)


FAMILIES: dict[str, type[Similarity2D] | type[Translation3D]] = {
    "similarity2d": Similarity2D,
    "translation3d": Translation3D,
}
SCOPES = {
    "similarity2d": "over all similarity poses of the stated scales",
    "translation3d": "over all translations, between norms about the target's centre",
}
