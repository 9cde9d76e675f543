"""The densest clique of a weighted consistency graph, relaxed: CLIPPER's projected ascent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dcreg.search import Budget

ASCENT_STEPS = 200  # per penalty
PENALTIES = 100
NO_WEIGHT = 1e-9  # weights up to this one count as zero
MIN_CHANGE = 1e-5  # of the weights; the ascent stops below it


def dense_clique(
    affinity: np.ndarray, consistent: np.ndarray, budget: Budget
) -> tuple[np.ndarray, bool]:
    """Return the clique of a local optimum of ``max u' M u``, and whether the ascent finished.

    Parameters
    ----------
    affinity : (n, n)
        M, 1 on the diagonal and 0 for inconsistent pairs.
    consistent : (n, n) bool
        Pairs that may both be chosen; true on the diagonal.

    Notes
    -----
    Maximises ``u' (M - d C̄) u`` over non-negative unit vectors, where C̄ marks inconsistent pairs, for
    penalties d that grow until no inconsistent pair has weight. Each ascent starts from the previous
    maximum. The final objective is about the size of the clique, and its members are the largest entries.
    """
    allowed = consistent.astype(affinity.dtype)

    def forbidden(u: np.ndarray) -> np.ndarray:
        """Return C̄ u."""
        return np.maximum(u.sum() - allowed @ u, 0.0)

    u = _leading_direction(affinity)
    penalty, finished = 0.0, True
    for _ in range(PENALTIES):
        gain, loss = affinity @ u, forbidden(u)
        clashing = (loss > NO_WEIGHT) & (u > NO_WEIGHT)
        if not clashing.any():
            break
        penalty += float((gain[clashing] / loss[clashing]).mean())
        u = _ascend(affinity, forbidden, u, penalty, budget)
        if budget.is_over:
            finished = False
            break
    size = max(1, round(float(u @ (affinity @ u))))
    return np.sort(np.argsort(-u, kind="stable")[:size]), finished


def _leading_direction(affinity: np.ndarray) -> np.ndarray:
    u = np.full(len(affinity), 1 / np.sqrt(len(affinity)))
    for _ in range(10):
        u = affinity @ u
        u /= np.linalg.norm(u)
    return u


def _ascend(
    affinity: np.ndarray,
    forbidden: Callable[[np.ndarray], np.ndarray],
    u: np.ndarray,
    penalty: float,
    budget: Budget,
) -> np.ndarray:
    """Find a local maximum for this penalty by gradient steps with backtracking and projection."""
    step = 1.0
    image = affinity @ u - penalty * forbidden(u)
    value = float(u @ image)
    for _ in range(ASCENT_STEPS):
        direction = image - value * u  # half the gradient, tangent to the sphere
        while step > 1e-6:
            trial = np.maximum(u + step * direction, 0.0)
            norm = np.linalg.norm(trial)
            if norm > 0:
                trial /= norm
                trial_image = affinity @ trial - penalty * forbidden(trial)
                trial_value = float(trial @ trial_image)
                if trial_value > value:
                    break
            step /= 2
            if budget.is_over:
                return u
        else:
            return u
        moved = float(np.abs(trial - u).max())
        u, image, value = trial, trial_image, trial_value
        step *= 2
        if moved < MIN_CHANGE or budget.is_over:
            break
    return u
