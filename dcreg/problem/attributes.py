"""Attributes of points, such as colours or intensities, and what they add to the costs of pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dcreg.problem.errors import InputError

# Limit on the square root of a cost, in extents of the target. Penalties of infeasible pairs are as
# large. Rounding errors of larger costs would exceed the tolerance.
LARGEST = 100.0


@dataclass(frozen=True)
class Attributes:
    """Attributes of the points of both clouds: colours, intensities or other descriptors.

    A pair with the residual r and the attributes a and b costs ``r^2 + scale^2 |a - b|^2``. If weights
    are also given, a pair of weight w costs ``w (r^2 + scale^2 |a - b|^2) + (1 - w) distance^2``.

    Attributes
    ----------
    source, target : (n,), (m,) or (n, f), (m, f) arrays
        One row of numbers per point, in the same unit for both clouds.
    scale : float
        Length in units of the target: an attribute distance of 1 costs as much as a residual of this
        length. For the noise s of a residual and the noise u of an attribute, s / u is a good choice.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> turned = np.roll(square, 1, axis=0)  # the turn of each colour to the next vertex
    >>> colours = dcreg.Attributes([0.0, 0.2, 0.5, 1.0], [0.0, 0.2, 0.5, 1.0], scale=0.5)
    >>> found = dcreg.register(square, turned, n_inliers=4, model="similarity2d", attributes=colours)
    >>> found.assignment[:, 1].tolist(), round(found.rotation_deg)
    ([0, 1, 2, 3], -90)
    """

    source: Any
    target: Any
    scale: Any

    def costs(self, n: int, m: int, extent: float) -> np.ndarray:
        """Return the (n, m) costs in addition to squared residuals.

        Parameters
        ----------
        n, m : int
            Numbers of points.
        extent : float
            Of the target.

        Raises
        ------
        InputError
        """
        scale = self._checked_scale()
        rows, columns = _checked("source", self.source, n), _checked("target", self.target, m)
        if rows.shape[1] != columns.shape[1]:
            raise InputError(
                f"attributes: source has {rows.shape[1]} numbers per point, target "
                f"{columns.shape[1]}; give the same attributes of both clouds"
            )
        costs = np.zeros((n, m))
        with np.errstate(over="ignore"):  # refused below
            for own, other in zip(scale * rows.T, scale * columns.T, strict=True):
                costs += (own[:, None] - other) ** 2
        most = float(np.sqrt(costs.max()))
        if not np.isfinite(most) or most > LARGEST * extent > 0.0:
            raise InputError(
                f"attributes: scale {scale:g} makes attributes cost as much as a residual of {most:g}, "
                f"more than {LARGEST:g} times the extent {extent:g} of the target; give a smaller "
                "scale, or exclude pairs by candidates"
            )
        return costs

    def _checked_scale(self) -> float:
        given = self.scale
        is_number = isinstance(given, int | float | np.number) and not isinstance(given, bool)
        if not (is_number and 0.0 < given < np.inf):
            raise InputError(
                f"attributes: scale {given!r} is not a positive number; give the residual, in units of "
                "the target, that costs as much as an attribute distance of 1"
            )
        return float(given)


def _checked(name: str, given: Any, count: int) -> np.ndarray:
    """Return the attributes of one cloud as an (n, f) array of finite numbers."""
    try:
        if np.ma.is_masked(given) or np.iscomplexobj(given):
            raise TypeError
        values = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"attributes: {name} is not an array of real numbers; give one row per point"
        ) from None
    if values.ndim not in (1, 2) or len(values) != count or not values.size:
        raise InputError(
            f"attributes: {name} has the shape {values.shape}, but there are {count} {name} points; "
            "give one number or one row per point"
        )
    values = values.reshape(count, -1)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if bad.size:
        raise InputError(
            f"attributes: {name} has {values[bad[0]].tolist()} in row {bad[0]}; give finite numbers"
        )
    return values
