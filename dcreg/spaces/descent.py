"""The descent that all spaces share: matching and pose in turn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_MAX_ROUNDS = 100


def alternate(
    theta: np.ndarray,
    value: float,
    col_of: np.ndarray,
    fit: Callable[[np.ndarray, np.ndarray], np.ndarray],
    evaluate: Callable[[np.ndarray], tuple[float, np.ndarray]],
    least_gain: float,
) -> tuple[np.ndarray, float, int]:
    """Fit the matched pairs and match anew, until the objective no longer falls.

    Parameters
    ----------
    theta : (dim,) array
    value : float
        The objective at `theta`; infinite where `theta` need not be admissible.
    col_of : (n,) int array
        The matching there.
    fit : callable
        From a parameter and a matching to the best parameter for the matching.
    evaluate : callable
        The objective at a parameter, and its matching.
    least_gain : float
        Share of the objective by which a step has to lower it; less is rounding.

    Returns
    -------
    theta, value, n_assignments
    """
    spent = 0
    for _ in range(_MAX_ROUNDS):
        trial = fit(theta, col_of)
        trial_value, trial_col = evaluate(trial)
        spent += 1
        if trial_value >= value * (1.0 - least_gain):
            break
        theta, value, col_of = trial, trial_value, trial_col
    return theta, value, spent
