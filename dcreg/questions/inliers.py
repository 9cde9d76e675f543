"""How many pairs fit at most? Bounds on the number of pairs within a distance.

Sums of squares give bounds: if k pairs lie within a distance d at some pose, the minimum E_k of the sum
of k squared residuals is at most k d^2. E_k / k does not decrease with k, because the k - 1 cheapest of
k pairs have at most the same mean. So if E_k > k d^2 is proven, no pose has k or more pairs within d. The
smallest such k is found by bisection. In most models, this takes a part of the time, and
`dcreg.questions.counting` then bounds the number itself over boxes of poses.

Poses found on the way, and fits to their pairs within d, give the number that is reached.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dcreg import text
from dcreg.answer import Answer
from dcreg.driver.auto import register_auto
from dcreg.driver.options import Limits, SolveOptions, check_positive
from dcreg.driver.solve import register_problem
from dcreg.files import plain
from dcreg.names import DEFAULT_TIME_LIMIT_S
from dcreg.problem import (
    Candidates,
    InputError,
    PoseRange,
    Problem,
    apply_pose,
    largest_matching,
)
from dcreg.questions.counting import count_search, has_count_search
from dcreg.result import Result
from dcreg.search import Budget
from dcreg.status import Status

_MAX_PAIRS = 4_000_000  # point pairs; more do not fit into a dense matrix of distances
_REFITS = 20
_LOCAL_EVERY = 16  # rounds of boxes with one local search
_BEYOND = 1.25  # distances up to which pairs are fitted as well, to bring them within one
_SHARE = 0.25  # of the time left, for one number of pairs; the last number gets the rest
# ... and for all of them before a search by bounds on the number, and for the choice of a pose between
_BISECTING, _CHOOSING = 0.2, 0.1


@dataclass(frozen=True, repr=False)
class MaxInliers(Answer):
    """Bounds on the largest number of pairs within a distance; see `dcreg.max_inliers`.

    Attributes
    ----------
    distance : float
        In units of the target.
    at_least : int
        Number of pairs within the distance at `T_target_source`.
    at_most : int
        No pose has more pairs within the distance.
    n_possible : int
        The largest number that the points and candidates allow; an `at_most` below it is proven.
    T_target_source : (d+1, d+1) array
        The best pose found. It is in the range of poses even if it has no pairs.
    assignment : (at_least, 2) int array
        The pairs: source row and target row.
    tried : list of (int, str)
        Numbers of pairs for which a search ran, with its status.
    time_s : float
    """

    distance: float
    at_least: int
    at_most: int
    n_possible: int
    T_target_source: np.ndarray
    assignment: np.ndarray
    tried: list[tuple[int, str]]
    time_s: float

    question = "largest number of pairs"

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """The pose that brings the pairs within the distance."""
        return {"pose": self.T_target_source}

    @property
    def is_exact(self) -> bool:
        """Whether both bounds agree."""
        return self.at_least == self.at_most

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return plain({**vars(self), "is_exact": self.is_exact})

    @property
    def answer(self) -> str:
        """The answer in a sentence."""
        if self.is_exact:
            return (
                f"exactly {text.count(self.at_least, 'pair')} within {self.distance:.12g}: proven"
            )
        is_lower = self.at_most < self.n_possible
        why = "proven" if is_lower else "what the points allow; no smaller number was proven"
        return (
            f"{self.at_least} to {text.count(self.at_most, 'pair')} within {self.distance:.12g} "
            f"(the upper end is {why})"
        )

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary."""
        yield "answer", self.answer
        yield "T_target_source", text.pose(self.T_target_source)
        yield (
            "searches",
            ", ".join(f"{text.count(k, 'pair')}: {status}" for k, status in self.tried),
        )
        yield "time", f"{self.time_s:.2f} s"


def max_inliers(
    source: np.ndarray,
    target: np.ndarray,
    *,
    distance: float,
    model: str,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    pose_range: PoseRange | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    options: SolveOptions | None = None,
) -> MaxInliers:
    """Bound the largest number of one-to-one pairs that a pose can bring within a distance.

    The lower bound is the number of pairs at the best pose found. No pose has more pairs than the upper
    bound, which a search has proven or which is the largest number that the points allow. The search
    ends when both agree. For ``similarity3d``, the proof uses sums of squares, so the upper bound is not
    tight if the residuals of further pairs are only a little above `distance`.

    Parameters
    ----------
    source, target, model, scale_range, candidates, pose_range
        As in `dcreg.register`.
    distance : float
        In units of the target.
    time_limit : float, optional
        Seconds for all searches together, without compilation; None or inf: no limit.
    options : SolveOptions, optional
        As in `dcreg.register`, without certificate and downsampling.

    Returns
    -------
    MaxInliers

    Raises
    ------
    InputError
        For bad input, before any search.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((12, 2))
    >>> target = np.vstack([points[:8] + 3.0, [[9.0, 9.0], [9.0, 3.0]]])
    >>> dcreg.max_inliers(points, target, distance=0.01, model="similarity2d").at_least
    8
    """
    check_positive("distance", distance, optional=False)
    first = Problem(source, target, 1, model, scale_range, candidates, pose_range)
    n, m = len(first.source), len(first.target)
    if n * m > _MAX_PAIRS:
        raise InputError(
            f"source, target: {n} x {m} pairs exceed {_MAX_PAIRS:,}; give fewer points, such as keypoints"
        )
    chosen = SolveOptions.of(options)
    if chosen.certificate:
        raise InputError("certificate: max_inliers keeps none; omit it")
    if chosen.downsample is not None:
        raise InputError("downsample: the question refers to all points; omit it")
    chosen.refuse_checkpoint()
    most = first.max_n_inliers
    limits = Limits(time_s=time_limit, max_rms=distance)
    limits.check(most)
    with Budget(time_limit) as budget:
        return _Search(first, distance, limits, chosen, budget).run(most)


class _Search:
    """The search for the largest number of pairs."""

    def __init__(
        self,
        problem: Problem,
        distance: float,
        limits: Limits,
        options: SolveOptions,
        budget: Budget,
    ) -> None:
        self.problem, self.distance, self.limits = problem, distance, limits
        self.options, self.budget = options, budget
        self.best = np.eye(problem.dim + 1), np.empty((0, 2), np.int64)
        self.tried: list[tuple[int, str]] = []

    def run(self, most: int) -> MaxInliers:
        """Search by bounds on sums of squares, then, where there are some, on the number of pairs."""
        whole, is_bounded = self.budget, has_count_search(self.problem, self.options)
        self.budget = whole.sub_budget(_BISECTING) if is_bounded else whole
        at_most = self._bisected(most)
        self.budget, is_stopped = whole, self.tried[-1][1] == Status.STOPPED.value
        if is_bounded and not (is_stopped or self.budget.is_over):
            if len(self.best[1]) < at_most:
                self._choose_poses()
            at_most = self._searched(at_most)
        T, pairs = self.best
        return MaxInliers(
            self.distance, len(pairs), at_most, most, T, pairs, self.tried, self.budget.elapsed()
        )

    def _bisected(self, most: int) -> int:
        """Halve the range of numbers that are neither reached nor refuted, then count its end down."""
        refuted, unknown = most + 1, 0  # the smallest refuted number, the largest one not refuted
        while refuted - unknown > 1 and not (self.tried and self.budget.is_over):
            k = most if not self.tried else (unknown + refuted) // 2
            status = self._solve(k)
            if status is Status.STOPPED:
                break
            if status is Status.REFUTED:
                refuted = k
            else:
                unknown = k
            unknown = max(unknown, len(self.best[1]))
        while self._is_open(refuted - 1) and not self.budget.is_over:
            if self._solve(refuted - 1, share=1.0) is not Status.REFUTED:
                break
            refuted -= 1
        return refuted - 1

    def _choose_poses(self) -> None:
        """Count the pairs at poses that fit best: without a given number, and for one more than known."""
        most, known = self.problem.max_n_inliers, -1
        limits = replace(self.limits, max_rms=None, nodes=1, time_s=self._share_of_left(_CHOOSING))
        found = register_auto(self.problem, limits, self.options)
        while True:
            self.budget.clock.exclude(found.time_setup_s)
            self._count(found.T_target_source)
            if not known < len(self.best[1]) < most or self.budget.is_over:
                break
            known = len(self.best[1])
            limits = replace(self.limits, nodes=1, time_s=self._share_of_left(_CHOOSING))
            problem = self.problem.with_n_inliers(known + 1)
            found = register_problem(problem, limits, self.options)

    def _share_of_left(self, share: float) -> float | None:
        """Return a share of the time left, in seconds."""
        left = self.budget.left()
        return None if left is None else max(0.05, share * left)

    def _searched(self, at_most: int) -> int:
        """Search for more pairs than are known, by bounds on their number; return the most possible."""
        if len(self.best[1]) == at_most:
            return at_most

        source, rounds = self.problem.source, itertools.count()

        def count(T: np.ndarray) -> int:
            T = self.problem.fit(source, apply_pose(T, source))  # the nearest admissible pose
            if next(rounds) % _LOCAL_EVERY == 0:
                self._count(T)
            else:
                self._pairs(T, self.distance)
            return len(self.best[1])

        proven = count_search(
            self.problem, self.distance, (self.best[0], len(self.best[1])), at_most, count,
            (self.limits, self.options), self.budget,
        )  # fmt: skip
        if proven < at_most:
            self.tried.append((proven + 1, Status.REFUTED.value))
        return proven

    def _is_open(self, k: int) -> bool:
        """Whether it is not known if k pairs are too many, and more time may tell."""
        return k > len(self.best[1]) and dict(self.tried).get(k) in (None, Status.TIME_LIMIT)

    def _solve(self, k: int, share: float = _SHARE) -> Status:
        """Decide whether k pairs can have an RMS residual of the distance; count at the pose found."""
        found: Result = register_problem(
            self.problem.with_n_inliers(k),
            replace(self.limits, time_s=self._share_of_left(share)),
            replace(self.options, prove=True),
        )  # fmt: skip
        # as in other searches, the time limit does not include compilation
        self.budget.clock.exclude(found.time_setup_s)
        if not self.tried:  # a pose that is admissible, even if it has no pairs
            self.best = found.T_target_source, self.best[1]
        self.tried.append((k, found.status.value))
        self._count(found.T_target_source)
        return found.status

    def _count(self, T: np.ndarray) -> None:
        """Alternate the pairs within the distance and their pose while their number grows."""
        problem, known = self.problem, 0
        for _ in range(_REFITS):
            rows, columns = self._pairs(T, self.distance)
            if len(rows) <= known or not len(rows):
                break
            known = len(rows)
            T = problem.fit(problem.source[rows], problem.target[columns])
        if known >= max(1, len(self.best[1]) - 1):
            self._balance(T)

    def _balance(self, T: np.ndarray) -> None:
        """Fit pairs slightly beyond the distance as well, with growing weights while they are beyond."""
        problem = self.problem
        rows, columns = self._pairs(T, _BEYOND * self.distance, is_kept=False)
        weights = np.ones(len(rows), np.int64)
        for _ in range(_REFITS):
            repeated = np.repeat(np.arange(len(rows)), weights)
            T = problem.fit(problem.source[rows[repeated]], problem.target[columns[repeated]])
            self._pairs(T, self.distance)
            gaps = apply_pose(T, problem.source[rows]) - problem.target[columns]
            weights += (gaps**2).sum(axis=1) > self.distance**2

    def _pairs(
        self, T: np.ndarray, reach: float, *, is_kept: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the most pairs within a distance at a pose; it is kept if there are more than ever."""
        problem = self.problem
        gaps = ((apply_pose(T, problem.source)[:, None] - problem.target) ** 2).sum(axis=2)
        within = gaps <= reach**2
        if problem.candidates is not None:
            within &= problem.candidates
        columns = largest_matching(within)
        rows = np.flatnonzero(columns >= 0)
        if is_kept and len(rows) > len(self.best[1]):
            self.best = T, np.column_stack([rows, columns[rows]])
        return rows, columns[rows]
