"""The proof of a 2D certificate in integers: no conclusion depends on floating-point rounding.

All numbers of a certificate and its clouds are doubles, and therefore multiples of a power of two. With
the factors a and b of a pose in units of 2^-P and lengths in units of 2^-q, the residuals are integers
in units of 2^-(P+q). Floating-point numbers only choose what any choice proves: dual variables, pairs,
and directions. `docs/certificate.md` states the bounds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from dcreg.certificate.assignment import cheapest_pairs, duals_of
from dcreg.certificate.format import INADMISSIBLE, Certificate, UnprovenError, require
from dcreg.certificate.proof import TANGENT_STEPS, Progress, check_partition

P = 60  # binary places of the factors a and b
HINT_BITS, HINT_LARGEST = 60, 1 << 300  # of costs that are converted to doubles, to choose duals
DIRECTIONS = 64  # in a quadrant, to bound the mean of some points
CACHE = 1 << 15  # profiles kept
DIGITS = 12  # of the numbers printed
# Error of a stated objective: of each residual, relative to the largest coordinate, and of each squared
# residual, relative to the squared size of the clouds.
RESIDUAL, SQUARE = Fraction(1, 2**50), Fraction(1, 2**52)


class Profile(NamedTuple):
    """A lower bound on the objective at one pose: the sum of the k smallest rows, minus `total`."""

    rows: np.ndarray
    total: int
    value: int  # the objective of some matching


class Matching(NamedTuple):
    """Some k one-to-one pairs, dual variables of the targets, and the lower bound that these prove."""

    duals: np.ndarray
    bound: int
    pairs: list[tuple[int, int]]


def smallest(rows: np.ndarray, k: int) -> np.ndarray:
    """Return the sum of the k smallest integers along the last axis."""
    return np.sort(rows, axis=-1)[..., :k].sum(axis=-1)


class ExactProof:
    """A proof in integers that the objective is at least a bound, by dividing the leaves further.

    Squared lengths are integers in units of 2^-2(P+q+1), because residuals are doubled.

    Parameters
    ----------
    c : Certificate
        Of model ``similarity2d``.
    source, target : (n, 2), (m, 2) arrays
    feasible : (n, m) bool array, optional
        The feasible pairs; default: all.
    max_boxes : int
        The proof fails after this number of boxes.
    progress : callable, optional
        Receives the boxes bounded and those known to be needed.
    """

    def __init__(
        self,
        c: Certificate,
        source: np.ndarray,
        target: np.ndarray,
        feasible: np.ndarray | None,
        max_boxes: int,
        progress: Progress | None = None,
    ) -> None:
        self.k, self.feasible = c.n_inliers, feasible
        self.max_boxes, self.progress = max_boxes, progress
        self.n_boxes = 0
        clouds = source, target, c.source_centre, c.target_centre
        q = max(P - math.frexp(c.unit)[1], *(_places(x) for cloud in clouds for x in cloud.flat))
        x, y, x_centre, y_centre = cloud_integers = [_integers(cloud, q) for cloud in clouds]
        self._largest = max(abs(cloud).max() for cloud in cloud_integers) << P
        self.x, self.y = x - x_centre, (y - y_centre) << P
        self.unit = Fraction(c.unit) * 2 ** (P + q)
        self.area = 4 * self.unit**2
        self._shift = max(0, int(self.area).bit_length() - HINT_BITS)
        self.low, self.high = _floor(c.scale_range[0], 2**P), _ceil(c.scale_range[1], 2**P)
        squares = (self.x**2).sum(axis=1)
        spread = math.isqrt(sum(squares) // len(squares))
        self.weights = np.array([spread, spread, 1, 1], dtype=object)
        self.is_uniform = self.k == len(x)
        # |(a + ib) x + (u + iv)|^2 is linear in these moments of a point
        self.moments = np.array([squares, *self.x.T, np.ones_like(squares)])
        if self.is_uniform:  # their sum over all points
            self.moments = self.moments.sum(axis=1, keepdims=True)
        self.profile = lru_cache(CACHE)(self._profile)

    # --- what is proven

    def check(self, c: Certificate) -> Fraction:
        """Check everything but the lower bounds of the leaves; return the objective of the stated pose.

        The objective is in normalised units. If rounding left the scale of the pose outside of the range,
        it is that of the nearest pose of the range.
        """
        check_partition(c.start_lower, c.start_upper, c.leaf_lower, c.leaf_upper, same=0.0)
        is_empty = c.leaf_reasons == INADMISSIBLE
        least = float(c.leaf_bounds[~is_empty].min(initial=np.inf))
        most, area = max(c.lower_bound, c.upper_bound - c.gap_tol), c.unit**2
        require(
            c.lower_bound <= least,
            f"lower_bound {c.lower_bound * area!r} does not follow: a leaf has {least * area!r}",
        )
        high = np.flatnonzero(~is_empty & (c.leaf_bounds > most))
        require(not high.size, f"leaf_bounds: leaf {high[:1]} states more than is needed")
        for leaf, lower, upper in self._leaves(c):
            require(
                not is_empty[leaf] or self._is_outside(lower, upper),
                f"leaf {leaf} is stated to contain no admissible parameter, but contains one",
            )
        value = self._attained(c)
        stated, found = c.lower_bound * area, float(value) * area
        require(
            c.lower_bound <= value,
            f"lower_bound: {stated!r} exceeds the objective {found!r} of the pose",
        )
        size = (abs(self.x).max() << P) * max(Fraction(c.scale_range[1]), 1) + abs(self.y).max()
        residual = self.k * (RESIDUAL * self._largest / self.unit) ** 2
        square = SQUARE * self.k * (size / self.unit) ** 2
        require(
            is_rounding(Fraction(c.upper_bound), value, residual, square),
            f"upper_bound: {c.upper_bound!r} stated, but the objective is {float(value)!r}",
        )
        return value

    def _attained(self, c: Certificate) -> Fraction:
        """Return the objective of the best pairs at the stated pose, in normalised units."""
        a, b = _admissible(c)
        u, v = (Fraction(shift) * self.unit for shift in c.theta[2:])
        pose = np.array([math.floor(each) for each in (a * 2**P, b * 2**P, u, v)], dtype=object)
        pairs = self._matched(self._costs(pose, pose)).pairs
        rows, columns = (list(each) for each in zip(*pairs, strict=True))
        is_matching = len({*rows}) == len({*columns}) == len(pairs) == self.k
        is_feasible = self.feasible is None or self.feasible[rows, columns].all()
        require(is_matching and is_feasible, f"upper_bound: no {self.k} pairs at the stated pose")
        total = Fraction(0)
        for (x, y), (to_x, to_y) in zip(self.x[rows] << P, self.y[columns], strict=True):
            total += (a * x - b * y + u - to_x) ** 2 + (b * x + a * y + v - to_y) ** 2
        return total / self.unit**2

    def run(self, c: Certificate, lower_bound: float) -> None:
        """Prove a lower bound of all poses.

        Raises
        ------
        UnprovenError
            If `max_boxes` boxes do not suffice.
        CertificateError
            If the bound is false.
        """
        needed = _ceil(lower_bound, self.area)
        boxes = [] if needed <= 0 else list(self._leaves(c))
        n_boxes = 0
        while boxes:
            leaf, lower, upper = boxes.pop()
            if n_boxes == self.max_boxes:
                raise UnprovenError(
                    f"leaf {leaf}: the lower bound {lower_bound * c.unit**2:.9g} could not be "
                    f"confirmed within {self.max_boxes} boxes"
                )
            n_boxes += 1
            self.n_boxes += 1
            if not self._is_proven(leaf, lower, upper, needed):
                boxes += [(leaf, *half) for half in self._halves(lower, upper)]
            if self.progress is not None and n_boxes % 64 == 0:
                self.progress(n_boxes, n_boxes + len(boxes))

    def _leaves(self, c: Certificate) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield number, lower and upper end of each leaf, rounded outwards.

        Leaves at the ends of the start box are extended to all poses that may be optimal.
        """
        scale = [Fraction(2**P)] * 2 + [self.unit] * 2
        most = self._region()
        for leaf, ends in enumerate(zip(c.leaf_lower, c.leaf_upper, strict=True)):
            lower, upper = (
                np.array([rounded(*each) for each in zip(end, scale, strict=True)], dtype=object)
                for rounded, end in zip((_floor, _ceil), ends, strict=True)
            )
            yield (
                leaf,
                np.where(ends[0] == c.start_lower, np.minimum(lower, most[0]), lower),
                np.where(ends[1] == c.start_upper, np.maximum(upper, most[1]), upper),
            )

    def _region(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of a box that contains every optimum.

        The optimal translation is (mean of k matched y) - A (mean of k matched x). A sum z of k points
        lies between two consecutive directions, ``z = s w + t w'`` with s, t >= 0. If its products with
        w and w' are at most h, then ``|z|^2 <= (s + t) h`` and, with the distance d of the line through
        w and w' from 0, ``|z| >= (s + t) d``. Thus ``|z| <= h / d``.
        """
        quadrant = [
            (round(2**30 * math.cos(angle)), round(2**30 * math.sin(angle)))
            for angle in np.arange(DIRECTIONS) * (0.5 * math.pi / DIRECTIONS)
        ]
        around = quadrant + [(-y, x) for x, y in quadrant]
        around += [(-x, -y) for x, y in around]
        directions = np.array(around, dtype=object)
        after = np.roll(directions, -1, axis=0)
        cross = directions[:, 0] * after[:, 1] - directions[:, 1] * after[:, 0]
        assert (cross > 0).all()
        sums = -smallest(-(directions @ self.x.T), self.k)
        largest = np.maximum(np.maximum(sums, np.roll(sums, -1)), 0)
        edges = ((after - directions) ** 2).sum(axis=1)
        square = max(
            Fraction(h * h * e, d * d) for h, e, d in zip(largest, edges, cross, strict=True)
        )
        reach = self.high * (math.isqrt(math.floor(square)) + 1)
        lower = (smallest(self.y.T, self.k) - reach) // self.k
        upper = -((smallest(-self.y.T, self.k) - reach) // self.k)
        ends = [-self.high] * 2 + [*lower], [self.high] * 2 + [*upper]
        return np.array(ends[0], dtype=object), np.array(ends[1], dtype=object)

    # --- the bound on one box

    def _is_proven(self, leaf: int, lower: np.ndarray, upper: np.ndarray, needed: int) -> bool:
        """Return whether all admissible poses of a box have at least the objective `needed`."""
        if self._is_outside(lower, upper):
            return True
        cost = self._costs(lower, upper)
        if smallest(cost.min(axis=1), self.k) >= needed or self._matched(cost).bound >= needed:
            return True
        centre = (lower + upper) // 2
        if (value := self.profile(tuple(centre)).value) < needed:
            is_admissible = not self._is_outside(centre, centre)
            require(
                not is_admissible,
                f"leaf {leaf}: the pose at its centre has the objective {float(value / self.area):.9g} "
                f"in normalised units, below {float(needed / self.area):.9g}",
            )
            return False
        return self._tangent_proves(lower, upper, needed)

    def _is_outside(self, lower: np.ndarray, upper: np.ndarray) -> bool:
        """Return whether all scales of a box are outside of the range."""
        lower, upper = lower[:2], upper[:2]
        nearest = np.maximum(np.maximum(lower, -upper), 0)
        farthest = np.maximum(-lower, upper)
        return bool((nearest**2).sum() > self.high**2 or (farthest**2).sum() < self.low**2)

    def _costs(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the (n, m) minimum squared residuals over a box, doubled before they are squared."""
        a, b, u, v = lower + upper
        wide_a, wide_b, wide_u, wide_v = upper - lower
        x, y = self.x.T
        far_x, far_y = abs(self.x.T)
        dx = abs((a * x - b * y + u)[:, None] - 2 * self.y[:, 0])
        dy = abs((b * x + a * y + v)[:, None] - 2 * self.y[:, 1])
        dx = np.maximum(dx - (wide_a * far_x + wide_b * far_y + wide_u)[:, None], 0)
        dy = np.maximum(dy - (wide_b * far_x + wide_a * far_y + wide_v)[:, None], 0)
        cost = dx * dx + dy * dy
        if self.feasible is None:
            return cost
        # more than any k feasible pairs, also among the hints
        most = (self.k + 1) * (cost.max() + (1 << self._shift))
        return np.where(self.feasible, cost, most)

    def _matched(self, cost: np.ndarray) -> Matching:
        """Return the best pairs and duals, up to rounding, and the lower bound that the duals prove."""
        hints = np.minimum(cost >> self._shift, HINT_LARGEST).astype(float)
        wide, columns = cheapest_pairs(hints, self.k)
        m = cost.shape[1]
        duals = np.array([int(d) << self._shift for d in duals_of(wide, columns)[:m]], dtype=object)
        bound = smallest((cost + duals).min(axis=1), self.k) - duals.sum()
        # rows without costs may have more pairs
        pairs = sorted(((i, j) for i, j in enumerate(columns) if j < m), key=lambda ij: cost[ij])
        return Matching(duals, bound, pairs[: self.k])

    def _profile(self, pose: tuple[int, ...]) -> Profile:
        theta = np.array(pose, dtype=object)
        cost = self._costs(theta, theta)
        found = self._matched(cost)
        rows = (cost + found.duals).min(axis=1)
        if self.is_uniform:
            rows = np.array([rows.sum()], dtype=object)
        return Profile(rows, found.duals.sum(), sum(cost[pair] for pair in found.pairs))

    def _tangent_proves(self, lower: np.ndarray, upper: np.ndarray, needed: int) -> bool:
        """Return whether the linearised objective is at least `needed` at all vertices.

        The objective of one matching is a difference of convex functions. With its first part replaced
        by the tangent at a base, it is concave, so its minimum is at a vertex v. There it is below the
        objective by the sum of ``|R(v - base) x|^2`` over the matched points.
        """
        vertices, profiles = [], []
        for vertex in dict.fromkeys(itertools.product(*zip(lower, upper, strict=True))):
            profiles.append(self.profile(vertex))
            if profiles[-1].value < needed:  # the linearised objective is not larger
                return False
            vertices.append(vertex)
        rows = np.array([profile.rows for profile in profiles])
        totals = np.array([profile.total for profile in profiles], dtype=object)
        doubled, base = 2 * np.array(vertices, dtype=object), lower + upper
        for step in range(TANGENT_STEPS):
            a, b, u, v = (doubled - base).T
            factors = [a * a + b * b, 2 * (u * a + v * b), 2 * (v * a - u * b), u * u + v * v]
            gaps = np.array(factors).T @ self.moments
            bounds = smallest(rows - gaps, 1 if self.is_uniform else self.k) - totals
            lowest = bounds.argmin()
            if bounds[lowest] >= needed:
                return True
            base = base + (doubled[lowest] - base) // (step + 2)
        return False

    def _halves(
        self, lower: np.ndarray, upper: np.ndarray
    ) -> Iterable[tuple[np.ndarray, np.ndarray]]:
        """Bisect a box along the edge that moves the source most."""
        axis = np.argmax((upper - lower) * self.weights)
        low, high = upper.copy(), lower.copy()
        low[axis] = high[axis] = (lower[axis] + upper[axis]) // 2
        return (lower, low), (high, upper)


# --- numbers --------------------------------------------------------------------------------------


def _floor(number: Fraction | float, unit: Fraction | int) -> int:
    """Return the largest integer that is at most ``number * unit``."""
    return math.floor(Fraction(number) * unit)


def _ceil(number: Fraction | float, unit: Fraction | int) -> int:
    return math.ceil(Fraction(number) * unit)


def _places(number: float) -> int:
    """Return the binary places of a double after the point."""
    return Fraction(number).denominator.bit_length() - 1


def _integers(values: np.ndarray, places: int) -> np.ndarray:
    """Return doubles, as exact integers in units of ``2^-places``."""
    integers = [_floor(value, 2**places) for value in values.flat]
    return np.array(integers, dtype=object).reshape(values.shape)


def _admissible(c: Certificate) -> tuple[Fraction, Fraction]:
    """Return the stated (a, b), moved onto the range of scales if rounding left it outside."""
    a, b = (Fraction(factor) for factor in c.theta[:2])
    low, high = (Fraction(end) for end in c.scale_range)
    if low**2 <= a * a + b * b <= high**2:
        return a, b
    scale = min(max(Fraction(math.hypot(a, b)), low), high)
    # every tangent of half an angle gives a rational point of the circle
    side = 1 if a > 0 else -1
    t = Fraction(math.tan(0.5 * math.atan2(side * b, side * a)))
    return side * scale * (1 - t * t) / (1 + t * t), side * scale * 2 * t / (1 + t * t)


def is_rounding(stated: Fraction, exact: Fraction, residual: Fraction, square: Fraction) -> bool:
    """Return whether two sums of squares differ by rounding only.

    Either by `square`, or their roots by the root of `residual`.
    """
    apart = stated + exact - residual  # at most twice the root of both iff the roots are near
    return abs(stated - exact) <= square or apart <= 0 or apart**2 <= 4 * stated * exact


def interval(
    c: Certificate, lower_bound: float, attained: Fraction
) -> tuple[str, str, float, float]:
    """Return both bounds in squared units of the target, rounded outwards: printed, and as doubles."""
    square = Fraction(c.unit) ** 2
    low, high = Fraction(lower_bound) * square, attained * square
    printed = decimal(low, ROUND_FLOOR), decimal(high, ROUND_CEILING)
    return *printed, rounded(low, -np.inf), rounded(high, np.inf)


def rounded(number: Fraction, towards: float) -> float:
    """Return the nearest double in the direction of `towards`."""
    value = float(number)
    is_beyond = value != number and (value > number) != (towards > value)
    return float(np.nextafter(value, towards)) if is_beyond else value


def decimal(number: Fraction, rounding: str) -> str:
    """Return a number with `DIGITS` digits, rounded up or down."""
    context = Context(prec=DIGITS, rounding=rounding)
    return format(context.divide(Decimal(number.numerator), Decimal(number.denominator)), "g")
