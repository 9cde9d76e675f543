"""Weights of points, and the costs of pairs that follow from weights and attributes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dcreg.problem.errors import InputError

WEIGHTED = ", weighted points"  # in the scope of bounds
LEAST = 1e-9  # least weight, relative to the largest one
# So few pairs are matched exactly in a quarter of a second, even after the time limit. Only then are the
# costs of pairs kept.
AT_ONCE_PAIRS = 1_200_000


@dataclass(frozen=True)
class PairWeights:
    """Costs of pairs: a squared residual r^2 becomes ``factors * r^2 + extra``.

    Attributes
    ----------
    factors : (n, m) array
        Above 0; the maximum is 1.
    extra : (n, m) array
        Not negative, in squared units of length.
    attributes : (n, m) array, optional
        The part of `extra` that attributes cause.
    """

    factors: np.ndarray
    extra: np.ndarray
    attributes: np.ndarray | None = None

    @property
    def name(self) -> str:
        """The setting that causes the costs, for messages."""
        return "weights" if self.attributes is None else "attributes"

    @property
    def are_weighted(self) -> bool:
        """Whether the factors differ from 1."""
        return bool(self.factors.min() < 1.0)

    @property
    def scope(self) -> str:
        """What the costs add to the scope of the bounds."""
        weighted = WEIGHTED if self.are_weighted else ""
        return weighted if self.attributes is None else weighted + ", with attributes"

    def costs(self, squares: np.ndarray) -> np.ndarray:
        """Return the costs of all pairs with these (n, m) squared residuals."""
        costs: np.ndarray = self.factors * squares + self.extra
        return costs

    def of(self, pairs: np.ndarray) -> np.ndarray:
        """Return the factors of (k, 2) pairs."""
        weights: np.ndarray = self.factors[pairs[:, 0], pairs[:, 1]]
        return weights

    def scaled(self, area: float) -> PairWeights:
        """Return the same costs in another unit of area, for a search."""
        return PairWeights(self.factors, self.extra * area)

    def attribute_cost(self, pairs: np.ndarray) -> float | None:
        """Return the part of the costs of (k, 2) pairs that attributes cause; None without them."""
        costs = self.attributes
        return None if costs is None else float(costs[pairs[:, 0], pairs[:, 1]].sum())

    def with_attributes(self, costs: np.ndarray) -> PairWeights:
        """Return the costs of the same pairs with (n, m) costs of their attributes."""
        weighted = self.factors * costs
        return PairWeights(self.factors, self.extra + weighted, weighted)


@dataclass(frozen=True)
class PointWeights:
    """Weights of the points of both clouds, such as inverse variances or confidences.

    The weight of a pair is the product of the weights of its points, divided by the maximum product. A
    pair of weight w with the residual r costs ``w r^2 + (1 - w) distance^2``: its missing weight counts
    like a residual of length `distance`. Light pairs are therefore not cheap. Among pairs with residuals
    below `distance`, heavier ones cost less.

    Attributes
    ----------
    source, target : (n,), (m,) arrays, optional
        Positive numbers; default: equal weights. In 2D, source weights give tighter bounds than target
        weights; in 3D, weights of the smaller cloud do.
    distance : float, optional
        In units of the target, such as the largest residual of a right pair. It can be omitted if only
        one cloud is weighted and all its points are matched: the sum of the weights is then the same for
        every matching, and a pair costs ``w r^2``.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((12, 2))
    >>> moved = points + 3.0
    >>> moved[0] += 0.5  # an error of the first point
    >>> weights = dcreg.PointWeights(source=[1e-6] + 11 * [1.0])
    >>> for given in (None, weights):
    ...     found = dcreg.register(points, moved, n_inliers=12, model="similarity2d", weights=given)
    ...     print(found.translation.round(3))
    [3.032 3.008]
    [3. 3.]
    """

    source: Any = None
    target: Any = None
    distance: float | None = None

    def of_pairs(self, n: int, m: int, n_inliers: int) -> PairWeights | None:
        """Return the costs of pairs; None if all points have the same weight.

        Raises
        ------
        InputError
        """
        rows, columns = _checked("source", self.source, n), _checked("target", self.target, m)
        is_flat = np.ptp(rows) == 0.0, np.ptp(columns) == 0.0
        distance = self._checked_distance()
        if distance is not None and self.source is None and self.target is None:
            raise InputError("weights: distance is given without weights; give source or target")
        if all(is_flat):
            return None
        check_costs("weights", n, m)
        # the matched weights add up to the same sum in every matching
        is_constant = (is_flat[1] and n_inliers == n) or (is_flat[0] and n_inliers == m)
        if distance is None and not is_constant:
            raise InputError(
                f"weights: with n_inliers={n_inliers} of {n} source and {m} target points, a matching "
                "could lower its cost by selecting points of low weight; give distance "
                "(--weight-distance), such as the largest residual of a true pair, or weight one cloud "
                "only and match all of its points"
            )
        factors = np.outer(rows / rows.max(), columns / columns.max())
        return PairWeights(factors, (1.0 - factors) * (distance or 0.0) ** 2)

    def _checked_distance(self) -> float | None:
        given = self.distance
        if given is None:
            return None
        is_number = isinstance(given, int | float | np.number) and not isinstance(given, bool)
        if not (is_number and 0.0 < given < np.inf):
            raise InputError(
                f"weights: distance {given!r} is not a positive number; give a length in units of the "
                "target, such as 0.1"
            )
        return float(given)


def check_costs(name: str, n: int, m: int) -> None:
    """Refuse more pairs than those whose costs are kept, before they take memory."""
    if n * m > AT_ONCE_PAIRS:
        raise InputError(
            f"{name}: {n} x {m} pairs exceed {AT_ONCE_PAIRS:,}; downsample both clouds first, or omit "
            f"{name}"
        )


def _checked(name: str, given: Any, count: int) -> np.ndarray:
    """Return the weights of one cloud as positive numbers."""
    if given is None:
        return np.ones(count)
    try:
        weights = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"weights: {name} is not an array of numbers; give one per point"
        ) from None
    if weights.shape != (count,):
        raise InputError(
            f"weights: {name} has the shape {weights.shape}, but there are {count} {name} points; give "
            "one number per point"
        )
    bad = np.flatnonzero(~((weights > 0.0) & np.isfinite(weights)))
    if bad.size:
        raise InputError(
            f"weights: {name} has {weights[bad[0]]} in row {bad[0]}; give positive numbers, and leave "
            "out points that should not count"
        )
    if weights.min() < LEAST * weights.max():
        raise InputError(
            f"weights: {name} ranges from {weights.min():g} to {weights.max():g}; leave out points with "
            f"less than {LEAST:g} times the largest weight"
        )
    return weights
