"""The fractional RMSE of the numbers of pairs at a pose, and the best of these numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Powers of the fractional RMSE. At a pose, the minimum is where the residuals of further pairs begin to
# exceed sqrt(1 + 2 * power) times the RMS of the others: 2.6 times for pairs as in a sweep, and twice for
# neighbours, because scans of different parts drift apart slowly. Between poses the smaller power
# decides; with the larger one, clutter that fits badly wins by its number.
POWER_OF_PAIRS, POWER_OF_NEIGHBOURS, POWER_OF_POSES = 3.0, 1.5, 1.5


@dataclass(frozen=True)
class Fit:
    """A pose and the numbers that are compared at it.

    Attributes
    ----------
    pose : (d+1, d+1) array
    numbers : (G,) array
        In ascending order, all of what is compared: pairs, or source points with a neighbour.
    rms : (G,) array
        RMS residuals, in units of the target.
    fractional : (G,) array
        Fractional RMSE of each number.
    best : int
        Index of the best number: of the minima of the fractional RMSE, the one with the smallest value.
    value : float
        That of the best number, by which poses are compared; the smallest one is the best.
    """

    pose: np.ndarray
    numbers: np.ndarray
    rms: np.ndarray
    fractional: np.ndarray
    best: int
    value: float

    @classmethod
    def of(
        cls,
        pose: np.ndarray,
        numbers: np.ndarray,
        rms: np.ndarray,
        power: float,
        values: np.ndarray | None = None,
    ) -> Fit:
        """Return the fit of residuals above 0; `values` compare poses, by default a fractional RMSE."""
        fractional = rms / numbers**power
        values = rms / numbers**POWER_OF_POSES if values is None else values
        # beyond the true pairs the fractional RMSE increases, but far beyond it can decrease again
        padded = np.pad(fractional, 1, constant_values=np.inf)
        is_minimum = (fractional <= padded[:-2]) & (fractional <= padded[2:])
        best = int(np.where(is_minimum, values, np.inf).argmin())
        return cls(pose, numbers, rms, fractional, best, float(values[best]))
