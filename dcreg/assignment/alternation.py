"""Alternation of matching and pose fit, by one-to-one pairs or by nearest neighbours."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from dcreg.assignment.kernels.dense import cheapest_pairs, improve_assignment
from dcreg.problem.trees import Tree
from dcreg.search import Budget, Interrupted

MAX_ROUNDS = 100
_MIN_GAIN_NEAREST = 1e-3  # relative decrease below which nearest neighbours are not followed

M = TypeVar("M")  # a matching, in whatever form


def alternate(
    theta: np.ndarray,
    value: float,
    matching: M,
    fit: Callable[[np.ndarray, M], np.ndarray | None],
    evaluate: Callable[[np.ndarray], tuple[float, M]],
    min_gain: float,
    max_rounds: int = MAX_ROUNDS,
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


def alternate_assignments(
    theta: np.ndarray,
    costs: Callable[[np.ndarray], np.ndarray],
    k: int,
    fit: Callable[[np.ndarray, np.ndarray], np.ndarray | None],
    min_gain: float,
    stop: np.ndarray,
    *,
    is_admissible: bool,
) -> tuple[np.ndarray, float, int]:
    """Alternate exact matching and pose fit; each assignment starts from the previous dual variables.

    Parameters
    ----------
    theta : array
    costs : callable
        From a parameter to the (n, m) costs of all pairs.
    k : int
        Pairs to match.
    fit, min_gain
        As in `alternate`.
    stop : (1,) uint8 array
    is_admissible : bool
        Whether `theta` may be returned.

    Returns
    -------
    theta, value, n_assignments

    Raises
    ------
    Interrupted
        `stop` was set.
    """
    duals: np.ndarray | None = None

    def evaluate(trial: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal duals
        if duals is None:
            value, col_of, duals = cheapest_pairs(costs(trial), k, stop)
        else:
            value, col_of = improve_assignment(costs(trial), k, duals, stop)
        if stop[0]:
            raise Interrupted
        return float(value), col_of

    value, col_of = evaluate(theta)
    theta, value, _, spent = alternate(
        theta, value if is_admissible else np.inf, col_of, fit, evaluate, min_gain
    )
    return theta, value, spent + 1


def follow_nearest(
    source: np.ndarray,
    tree: Tree,
    poses: np.ndarray,
    k: int,
    fit_pairs: Callable[[np.ndarray, np.ndarray], np.ndarray],
    budget: Budget | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Alternate the k nearest neighbours and their pose while their distance falls, from several poses.

    Parameters
    ----------
    source : (n, d) array
    tree : Tree
        Of the target.
    poses : (P, d+1, d+1) array
    k : int
    fit_pairs : callable
        From (P, k, d) source and target points to the (P, d+1, d+1) poses of these pairs.
    budget : Budget, optional

    Returns
    -------
    (P, d+1, d+1) array, (P,) array
        Where each ended, and the sum of squared distances of its pairs, which are not one-to-one.
    """
    d = source.shape[1]
    ends, values = poses.copy(), np.full(len(poses), np.inf)
    active, trials = np.arange(len(poses)), poses
    for _ in range(MAX_ROUNDS):
        moved = source @ np.swapaxes(trials[:, :d, :d], 1, 2) + trials[:, None, :d, d]
        distances, columns = tree.nearest(moved.reshape(-1, d))
        distances, columns = (each.reshape(moved.shape[:2]) for each in (distances, columns))
        rows = np.argsort(distances, axis=1, kind="stable")[:, :k]
        found = (np.take_along_axis(distances, rows, axis=1) ** 2).sum(axis=1)
        better = found < values[active] * (1.0 - _MIN_GAIN_NEAREST)
        active, rows = active[better], rows[better]
        ends[active], values[active] = trials[better], found[better]
        if not len(active) or (budget is not None and budget.is_over):
            break
        near = np.take_along_axis(columns[better], rows, axis=1)
        trials = fit_pairs(source[rows], tree.points[near])
    return ends, values
