"""The problem over given matches, and the checks of its input."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dcreg.families.matches.kernels.lists import MatchList, scores
from dcreg.problem import InputError, rounding_error
from dcreg.problem.geometry import fit_pose
from dcreg.problem.problem import check_points

MIN_MATCHES = 3  # that determine a rigid pose


@dataclass(frozen=True)
class MatchProblem:
    """Minimise a cost over rigid poses T and one-to-one selections P of matches.

    The cost is ``sum over P of |T(x_i) - y_j|^2 + inlier_threshold^2 (max_cardinality - |P|)``. A match
    whose residual exceeds the threshold costs more than no match. An optimum that selects k matches
    also minimises the objective of `dcreg.register` with ``n_inliers = k`` over these feasible pairs.

    Attributes
    ----------
    source, target : (n, 3), (m, 3) arrays
    pairs : (N, 2) int array
        The matches, each once: source row and target row.
    inlier_threshold : float
        Residual above which a match counts as wrong.
    """

    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray
    inlier_threshold: float

    @classmethod
    def checked(
        cls, source: np.ndarray, target: np.ndarray, matches: np.ndarray, inlier_distance: float
    ) -> MatchProblem:
        """Check the input and return the problem.

        Raises
        ------
        InputError
        """
        source = check_points("source", source, 3, "rigid3d")
        target = check_points("target", target, 3, "rigid3d")
        is_number = isinstance(inlier_distance, float | int | np.number)
        if not is_number or not 0 < inlier_distance < np.inf:
            raise InputError(
                f"inlier_distance: {inlier_distance!r} is not a positive number; give a length of about "
                "three times the noise"
            )
        return cls(
            source, target, check_matches(matches, len(source), len(target)), float(inlier_distance)
        )

    @cached_property
    def list(self) -> MatchList:
        """The matches as kernels take them, with the source centred at the mean of its matched points."""
        return self.part(np.arange(len(self.pairs)))

    @cached_property
    def centre(self) -> np.ndarray:
        """Mean of the matched source points."""
        return self.source[self.pairs[:, 0]].mean(axis=0)

    def part(self, chosen: np.ndarray) -> MatchList:
        """Return some of the matches, renumbered, with the same centre."""
        rows, columns = self.pairs[chosen].T
        row_names, row_numbers = np.unique(rows, return_inverse=True)
        column_names, column_numbers = np.unique(columns, return_inverse=True)
        return MatchList(
            self.source[rows] - self.centre, self.target[columns], row_numbers, column_numbers,
            len(row_names), len(column_names), self.inlier_threshold,
        )  # fmt: skip

    @property
    def max_cardinality(self) -> int:
        """Maximum number of matches in a one-to-one selection."""
        return min(self.list.n_rows, self.list.n_columns)

    @property
    def rounding(self) -> float:
        """Rounding error of the cost; with a tiny threshold far less than the cost of no match."""
        count = self.max_cardinality
        none_selected = count * self.inlier_threshold**2
        return min(rounding_error(self.source, self.target, count), 1e-8 * none_selected)

    @property
    def floor(self) -> float:
        """A lower bound on the cost without a search; 0 if none is known.

        A pose that selects all matches costs at least their least squares. Any other pose costs at least
        one unselected match. If the former cost less, they are the minimum.
        """
        if len(self.pairs) > self.max_cardinality:  # a point is in several matches
            return 0.0
        fitted = fit_pose(self.list.source, self.list.target, (1.0, 1.0))[:3]
        least = float(self.residuals(fitted).sum())
        return max(0.0, least - self.rounding) if least <= self.inlier_threshold**2 else 0.0

    def pose(self, centred: np.ndarray) -> np.ndarray:
        """Return the (4, 4) matrix of a (3, 4) pose of the centred source."""
        T = np.vstack([centred, [0.0, 0.0, 0.0, 1.0]])
        T[:3, 3] -= T[:3, :3] @ self.centre
        return T

    def scores(self, poses: np.ndarray) -> np.ndarray:
        """Return quick upper bounds on the scores of (P, 3, 4) centred poses."""
        out = np.empty(len(poses))
        scores(self.list, np.ascontiguousarray(poses), out)
        return out

    def residuals(self, centred: np.ndarray) -> np.ndarray:
        """Return the squared residuals of all matches."""
        moved = self.list.source @ centred[:, :3].T + centred[:, 3]
        return ((moved - self.list.target) ** 2).sum(axis=1)

    def score(self, cost: float) -> float:
        """Return a cost as a score: a selected match counts 1 - (residual / inlier_threshold)^2."""
        return self.max_cardinality - cost / self.inlier_threshold**2

    def cost(self, centred: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the minimum cost at a centred pose, and the matches selected for it."""
        square = self.residuals(centred)
        near = np.flatnonzero(square < self.inlier_threshold**2)
        chosen = near[_one_to_one(self.list, near, square[near])]
        value = square[chosen].sum() + self.inlier_threshold**2 * (
            self.max_cardinality - len(chosen)
        )
        return float(value), chosen


def check_matches(matches: np.ndarray, n: int, m: int) -> np.ndarray:
    """Return (N, 2) distinct rows of both clouds, in the given order; raise `InputError` if invalid."""
    try:
        pairs = np.asarray(matches, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("matches: not an array of numbers; give (N, 2) row numbers") from None
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(
            f"matches: shape {pairs.shape}; give (N, 2): source row and target row of each"
        )
    bad = ~((pairs == np.round(pairs)) & (pairs >= 0) & (pairs < [n, m])).all(axis=1)
    if bad.any():
        at = int(np.argmax(bad))
        raise InputError(
            f"matches: {pairs[at].tolist()} in row {at} is not a pair of rows; use integers from 0 to "
            f"{n - 1} and from 0 to {m - 1}"
        )
    _, first = np.unique(pairs, axis=0, return_index=True)
    if len(first) < MIN_MATCHES:
        raise InputError(f"matches: {len(first)} different ones; a rigid pose needs {MIN_MATCHES}")
    return pairs[np.sort(first)].astype(np.int64)


def _one_to_one(matches: MatchList, near: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Return the one-to-one selection from `near` with the maximum sum of ``reach^2 - square``."""
    rows, row_of = np.unique(matches.rows[near], return_inverse=True)
    columns, column_of = np.unique(matches.columns[near], return_inverse=True)
    if len(rows) == len(near) and len(columns) == len(near):
        return np.arange(len(near))
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    n, m = len(rows), len(columns)
    penalty = matches.reach**2
    own = np.arange(n)  # a separate column for every row that stays unmatched
    shift = penalty  # the same for every row; the solver reads zero as a missing edge
    graph = csr_array(
        (
            np.concatenate([square, np.full(n, penalty)]) + shift,
            (np.concatenate([row_of, own]), np.concatenate([column_of, m + own])),
        ),
        shape=(n, m + n),
    )
    _, chosen = min_weight_full_bipartite_matching(graph)
    return np.flatnonzero(chosen[row_of] == column_of)
