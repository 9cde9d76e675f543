"""The polish of the final pose: a local search, which alternates matching and pose fit."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.alternation import alternate
from dcreg.assignment.large import descend
from dcreg.assignment.objective import is_large, objective, weighted_objective
from dcreg.problem import Problem
from dcreg.search import Budget

__all__ = ["alternate", "polish"]
_MIN_GAIN = (
    1e-12  # relative decrease of the objective below which the polish ends; less is rounding
)


def polish(
    problem: Problem,
    T_target_source: np.ndarray,
    budget: Budget | None = None,
    known: tuple[float, np.ndarray] | None = None,
) -> tuple[np.ndarray, float, np.ndarray, int]:
    """Alternate matching and least-squares pose from `T_target_source` until neither changes.

    Parameters
    ----------
    problem : Problem
    T_target_source : (d+1, d+1) array
    budget : Budget, optional
        No further step begins when it is over.
    known : (objective, pairs), optional
        Those of `T_target_source`.

    Returns
    -------
    T_target_source, objective, assignment, n_assignments
        Never worse than the pose given.
    """
    budget = budget or Budget()
    source, target, n_inliers = problem.source, problem.target, problem.n_inliers
    candidates, weights = problem.candidates, problem.weights

    def evaluate(T: np.ndarray) -> tuple[float, np.ndarray]:
        if weights is not None:
            return weighted_objective(problem, T)
        return objective(source, target, T, n_inliers, candidates, stop=budget.hard_stop)

    def fit(T: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
        if budget.is_over:
            return None
        own = None if weights is None else weights.of(pairs)
        return problem.fit(source[pairs[:, 0]], target[pairs[:, 1]], own)

    if candidates is weights is None and is_large(len(source), len(target)):
        return _polish_large(problem, T_target_source, budget, known)
    value, pairs = known or evaluate(T_target_source)
    T, value, pairs, spent = alternate(T_target_source, value, pairs, fit, evaluate, _MIN_GAIN)
    return T, value, pairs, spent + (known is None)


def _polish_large(
    problem: Problem,
    T: np.ndarray,
    budget: Budget,
    known: tuple[float, np.ndarray] | None,
) -> tuple[np.ndarray, float, np.ndarray, int]:
    """Return the end of a local search on large clouds, or the pose given if that is better."""
    if known is not None and budget.is_over:
        return T, *known, 0
    found = descend(problem, T, budget)
    if known is not None and known[0] <= found.value:
        return T, *known, found.n_assignments
    return found.T_target_source, found.value, found.pairs, found.n_assignments
