"""The strongest aggregated term-wise bound (R3): all McCormick facets in one linear programme.

R1 keeps the mean of two facets of every product, so that matching and pose separate. R3 keeps all facets
and minimises jointly over matching, features, products and pose; no choice of single facets can be
stronger. Like R1 and R2 it is a reconstruction of the family of RPM-HTB. It is slow and serves comparison
only.

The programme over P is solved by column generation. HiGHS solves the master problem over some matchings;
one exact k-assignment finds the next matching from its duals. The bound returned is the Lagrangian one,

    y b + sum_v min_{[l_v, u_v]} (reduced cost of v) v + min_P sum p_ij (yy_ij - sum_f alpha_f f_ij),

valid for any multipliers y of the right sign: tolerances of the LP solver cannot make it too large.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from scipy.optimize import OptimizeResult, linprog

from baselines._shared.kernels.products import BILINEAR, N_FEATURES
from baselines.rpm_htb.bounds import TermwiseBound
from baselines.rpm_htb.kernels import TRILINEAR
from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Box, Boxes, Evaluation

MAX_ROUNDS = 100
RECENT = 40  # matchings kept for the next boxes
PRECISION = 1e-9  # of the bound, relative to the terms of the objective
VIOLATION = 1e-6  # of a tangent; above the tolerance of the LP solver

# Columns of the master problem: pose, products t_a t_b, squares t_3^2 and t_4^2, products of an
# aggregate with those and with the pose, aggregates, then the known matchings.
_PAIRS = [(int(a), int(b)) for _, a, b, _ in TRILINEAR]
_POSE, _PAIR, _SQUARE, _CUBIC, _BILINEAR, _AGGREGATE = np.split(
    np.arange(4 + len(_PAIRS) + 2 + len(_PAIRS) + len(BILINEAR) + N_FEATURES),
    np.cumsum([4, len(_PAIRS), 2, len(_PAIRS), len(BILINEAR)]),
)
_N_COLUMNS = int(_AGGREGATE[-1]) + 1


class TermwiseR3(TermwiseBound):
    """The joint LP relaxation; the candidate is its pose with the nearest admissible scale."""

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        assert isinstance(space, Similarity2D), "R3 is written for 2D only"
        self.scale_range = space.scale_range
        self.planes = self.features.reshape(len(self.features), -1)
        extremes = [sign * plane for plane in self.planes[:-1] for sign in (1.0, -1.0)]
        self.extremes = np.array([self._assign(cost)[1] for cost in extremes])
        self.low, self.high = self.extremes.min(axis=0)[:-1], self.extremes.max(axis=0)[:-1]
        self.recent: deque[np.ndarray] = deque(maxlen=RECENT)  # initial matchings of the next box

    def _assign(self, cost: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the minimum of `cost` over all matchings, and the aggregates of a minimiser."""
        shape = self.features.shape[1:]
        value, col_of, _ = cheapest_pairs(
            np.ascontiguousarray(cost.reshape(shape)), self.space.n_inliers, self.space.stop_flag
        )
        self.n_assignments += 1
        self.matching = col_of  # of the last assignment
        rows = np.flatnonzero(col_of >= 0)
        return float(value), self.features[:, rows, col_of[rows]].sum(axis=1)

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        enough = np.inf if cutoff is None else cutoff
        found, matchings = Evaluation.empty(boxes), self.no_matchings(len(boxes))
        for at, (lower, upper) in enumerate(zip(boxes.lower, boxes.upper, strict=True)):
            self.space.check()
            found.lower_bounds[at], theta = self._solve(lower, upper, enough)
            found.thetas[at], matchings[at] = self._project(theta), self.matching
        self.n_assignments += self.space.objectives(found.thetas, found.values)
        return found

    def _solve(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float
    ) -> tuple[float, np.ndarray]:
        """Return bound and pose of one box."""
        master = _Master(lower, upper, self.low, self.high, self.space.n_inliers)
        matchings = np.vstack([self.extremes, *self.recent])
        bound, theta = -np.inf, 0.5 * (lower + upper)
        for _ in range(MAX_ROUNDS):
            solution = master.solve(matchings)
            if not solution.success:  # earlier bounds remain valid
                break
            theta = np.clip(solution.x[_POSE], lower, upper)
            relaxed, alpha = master.relaxed(solution)
            value, matching = self._assign(self.planes[-1] - alpha @ self.planes[:-1])
            bound = max(bound, relaxed + value)
            closed = solution.fun - bound <= PRECISION * (1.0 + abs(matching[-1]) + abs(bound))
            if bound >= cutoff or (not master.cut(theta, solution.x) and closed):
                break
            matchings = np.vstack([matchings, matching])
            self.recent.append(matching)
        return bound, theta

    def _project(self, theta: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        scale = np.hypot(theta[0], theta[1])
        if scale == 0.0:
            return np.array([low, 0.0, theta[2], theta[3]])
        factor = np.clip(scale, low, high) / scale
        return theta * [factor, factor, 1.0, 1.0]


class _Master:
    """The linear programme of one box over the known matchings."""

    def __init__(
        self, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray, k: int
    ) -> None:
        self.low, self.high, self.cost = (
            np.empty(_N_COLUMNS),
            np.empty(_N_COLUMNS),
            np.zeros(_N_COLUMNS),
        )
        self.low[_POSE], self.high[_POSE] = lower, upper
        self.low[_AGGREGATE], self.high[_AGGREGATE] = low, high
        self._rows: list[np.ndarray] = []
        self._right: list[float] = []
        self._squares = [
            *((w, a) for w, (a, b) in zip(_PAIR, _PAIRS, strict=True) if a == b),
            *zip(_SQUARE, _POSE[2:], strict=True),
        ]
        for w, (a, b) in zip(_PAIR, _PAIRS, strict=True):
            if a != b:
                self._product(w, a, b)
        for w, a in self._squares:
            self._square(w, a)
        for z, w, (f, _, _, c) in zip(_CUBIC, _PAIR, TRILINEAR, strict=True):
            self._product(z, _AGGREGATE[f], w)
            self.cost[z] = c
        for z, (f, a) in zip(_BILINEAR, BILINEAR, strict=True):
            self._product(z, _AGGREGATE[f], a)
            self.cost[z] = -2.0
        self.cost[_SQUARE] = k

    def _product(self, w: int, u: int, v: int) -> None:
        """Add the four McCormick facets of w = u v."""
        ul, uh, vl, vh = self.low[u], self.high[u], self.low[v], self.high[v]
        corners = (ul * vl, ul * vh, uh * vl, uh * vh)
        self.low[w], self.high[w] = min(corners), max(corners)
        for at_u, at_v, sign in ((ul, vl, 1.0), (uh, vh, 1.0), (uh, vl, -1.0), (ul, vh, -1.0)):
            self._add({w: -sign, u: sign * at_v, v: sign * at_u}, sign * at_u * at_v)

    def _square(self, w: int, a: int) -> None:
        """Add secant and three tangents of w = a^2."""
        low, high = self.low[a], self.high[a]
        self.low[w] = max(low, -high, 0.0) ** 2
        self.high[w] = max(-low, high) ** 2
        self._add({w: 1.0, a: -(low + high)}, -low * high)
        for at in np.unique([low, 0.5 * (low + high), high]):
            self._tangent(w, a, at)

    def _tangent(self, w: int, a: int, at: float) -> None:
        self._add({w: -1.0, a: 2.0 * at}, at * at)

    def _add(self, entries: dict[int, float], right: float) -> None:
        """Add a row ``sum entries <= right``."""
        row = np.zeros(_N_COLUMNS)
        row[list(entries)] = list(entries.values())
        self._rows.append(row)
        self._right.append(right)

    def cut(self, theta: np.ndarray, x: np.ndarray) -> bool:
        """Add the tangents of squares that `x` violates; return whether there are any."""
        violated = [(w, a) for w, a in self._squares if theta[a] ** 2 - x[w] > VIOLATION]
        for w, a in violated:
            self._tangent(w, a, theta[a])
        return bool(violated)

    def solve(self, matchings: np.ndarray) -> OptimizeResult:
        """Solve over the convex hull of `matchings`, whose last column is the constant term yy."""
        count = len(matchings)
        features = np.hstack([np.zeros((N_FEATURES, _N_COLUMNS)), matchings[:, :-1].T])
        features[np.arange(N_FEATURES), _AGGREGATE] = -1.0
        convex = np.concatenate([np.zeros(_N_COLUMNS), np.ones(count)])
        bounds = np.vstack(
            [np.stack([self.low, self.high], axis=1), np.tile([0.0, 1.0], (count, 1))]
        )
        return linprog(
            np.concatenate([self.cost, matchings[:, -1]]),
            A_ub=np.hstack([np.array(self._rows), np.zeros((len(self._rows), count))]),
            b_ub=np.array(self._right),
            A_eq=np.vstack([features, convex]),
            b_eq=np.concatenate([np.zeros(N_FEATURES), [1.0]]),
            bounds=bounds,
            method="highs",
        )

    def relaxed(self, solution: OptimizeResult) -> tuple[float, np.ndarray]:
        """Return the Lagrangian bound without the matching, and the duals alpha of the aggregates."""
        y = np.minimum(solution.ineqlin.marginals, 0.0)
        alpha = solution.eqlin.marginals[:-1]
        reduced = self.cost - y @ np.array(self._rows)
        reduced[_AGGREGATE] += alpha
        least = np.minimum(reduced * self.low, reduced * self.high).sum()
        return float(y @ np.array(self._right) + least), alpha
