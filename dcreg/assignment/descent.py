"""Local searches, which alternate matching and pose fit, and the polish of the final pose."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dcreg.assignment.objective import is_large, objective
from dcreg.assignment.sparse import nearest_pairs, tree_of
from dcreg.problem import Problem
from dcreg.problem.geometry import apply_pose, fit_pose
from dcreg.search import Budget

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_MAX_ROUNDS = 100
_MAX_LARGE_ROUNDS = 10
# Relative decrease of the objective below which a descent ends.
_MIN_GAIN, _MIN_GAIN_LARGE, _MIN_GAIN_NEAREST = 1e-12, 1e-4, 1e-3

_FEW = 4000  # points of the source that follow their nearest neighbours first, of a large cloud
_HUGE = 100_000  # points of both clouds, of which one matching takes seconds

M = TypeVar("M")  # a matching, in whatever form


def alternate(
    theta: np.ndarray,
    value: float,
    matching: M,
    fit: Callable[[np.ndarray, M], np.ndarray | None],
    evaluate: Callable[[np.ndarray], tuple[float, M]],
    min_gain: float,
    max_rounds: int = _MAX_ROUNDS,
) -> tuple[np.ndarray, float, M, int]:
    """Alternate the best pose for a matching and the best matching at a pose while the objective falls.

    Parameters
    ----------
    theta : array
        A pose, or its parameter.
    value : float
        The objective at `theta`; infinite if `theta` need not be admissible.
    matching
        The matching at `theta`.
    fit : callable
        From a pose and a matching to the best pose for the matching, or None to end the descent.
    evaluate : callable
        From a pose to the objective and the matching.
    min_gain : float
        Relative decrease of the objective below which the descent ends; less is rounding.
    max_rounds : int

    Returns
    -------
    theta, value, matching, n_evaluations
    """
    spent = 0
    while spent < max_rounds and (trial := fit(theta, matching)) is not None:
        trial_value, trial_matching = evaluate(trial)
        spent += 1
        if trial_value >= value * (1.0 - min_gain):
            break
        theta, value, matching = trial, trial_value, trial_matching
    return theta, value, matching, spent


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
    scale_range, candidates = problem.scale_range, problem.candidates
    large = candidates is None and is_large(len(source), len(target))

    def evaluate(T: np.ndarray) -> tuple[float, np.ndarray]:
        return objective(
            source, target, T, n_inliers, candidates, prove=not large, stop=budget.hard_stop
        )

    def fit(T: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
        if budget.is_over:
            return None
        if large and T is T_target_source:  # nearest neighbours first, which take no matching
            return _near_fit(source, target, T, n_inliers, scale_range, budget)
        return fit_pose(source[pairs[:, 0]], target[pairs[:, 1]], scale_range)

    value, pairs = known or evaluate(T_target_source)
    min_gain, max_rounds = (
        (_MIN_GAIN_LARGE, _MAX_LARGE_ROUNDS) if large else (_MIN_GAIN, _MAX_ROUNDS)
    )
    is_huge = len(source) + len(target) > _HUGE
    max_rounds = 1 if is_huge else max_rounds
    T, value, pairs, spent = alternate(
        T_target_source, value, pairs, fit, evaluate, min_gain, max_rounds
    )
    spent += known is None
    if large and not is_huge and not budget.is_over:
        proved_value, proved_pairs = objective(source, target, T, n_inliers, stop=budget.hard_stop)
        spent += 1
        if proved_value < value:
            value, pairs = proved_value, proved_pairs
    return T, value, pairs, spent


def _near_fit(
    source: np.ndarray,
    target: np.ndarray,
    T: np.ndarray,
    k: int,
    scale_range: tuple[float, float],
    budget: Budget,
) -> np.ndarray:
    """Return the pose at which few points, and then all, stop following their nearest neighbours."""
    tree = tree_of(target)
    few = source[:: -(-len(source) // _FEW)]
    share = max(3, round(k * len(few) / len(source)))
    T, _ = follow_nearest(few, tree, T, share, scale_range, budget)
    return follow_nearest(source, tree, T, k, scale_range, budget)[0]


def follow_nearest(
    source: np.ndarray,
    tree: cKDTree,
    T: np.ndarray,
    k: int,
    scale_range: tuple[float, float],
    budget: Budget | None = None,
) -> tuple[np.ndarray, float]:
    """Alternate the k nearest neighbours and the least-squares pose while their distance falls.

    Returns the final pose and the sum of squared distances of its pairs, which are not one-to-one. `tree`
    contains the target.
    """

    def evaluate(T: np.ndarray) -> tuple[float, np.ndarray]:
        pairs, value = nearest_pairs(apply_pose(T, source), tree, k)
        return value, pairs

    def fit(T: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
        if budget is not None and budget.is_over:
            return None
        return fit_pose(source[pairs[:, 0]], tree.data[pairs[:, 1]], scale_range)

    value, pairs = evaluate(T)
    T, value, _, _ = alternate(T, value, pairs, fit, evaluate, _MIN_GAIN_NEAREST, _MAX_ROUNDS - 1)
    return T, value
