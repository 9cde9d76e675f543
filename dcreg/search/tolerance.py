"""The gap at which a search stops, and its status then."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from dcreg.status import Status

_ABOVE = 1.0 + 1e-9  # a lower bound that exceeds a value by this factor is above it


@dataclass(frozen=True)
class Tolerance:
    """A gap of at most ``max(rel * upper_bound, abs)`` counts as closed.

    Attributes
    ----------
    rel : float
        Share of the upper bound, below 1.
    abs : float
        In the units of the objective.
    exact : float, optional
        An upper bound of at most this value counts as 0, so no lower bound is needed. A lower bound of 0,
        which holds for every sum of squares, does not prove a larger upper bound: if the gap closes with
        this lower bound, the status is ``converged``. Default: the gap alone decides, as in Algorithm 1.
    target : float, optional
        The search ends when it is known whether the minimum is at most this value: as ``converged`` with
        an upper bound of at most `target`, as ``refuted`` with a lower bound above it.
    margin : float
        Rounding error of an objective near the target: the lower bound must exceed the target by more.
    """

    rel: float = 0.0
    abs: float = 0.0
    exact: float | None = None
    target: float | None = None
    margin: float = 0.0

    @property
    def enough(self) -> float:
        """An upper bound of at most this value ends the search, whatever the lower bound.

        With a target, no gap ends the search before the target is met or refuted.
        """
        return max(self.abs if self.target is None else self.target, self.exact or 0.0)

    def is_exact(self, upper_bound: float) -> bool:
        """Tell whether an upper bound counts as 0."""
        return self.exact is not None and upper_bound <= self.exact

    def allowed(self, upper_bound: float) -> float:
        """Return the gap that counts as closed."""
        if not math.isfinite(upper_bound):
            return self.abs
        gap = max(self.rel * upper_bound, self.abs)
        return max(gap, upper_bound) if self.is_exact(upper_bound) else gap

    def cutoff(self, upper_bound: float) -> float:
        """Return the lower bound at which the search ends; it falls with the upper bound."""
        if self.target is not None and upper_bound > self.target:
            return (self.target + self.margin) * _ABOVE
        return upper_bound - self.allowed(upper_bound)

    def status(self, lower_bound: float, upper_bound: float) -> Status | None:
        """Return the status of a search with these bounds; None if the gap is open."""
        if self.target is not None and upper_bound > self.target:
            return Status.REFUTED if lower_bound > self.target + self.margin else None
        if lower_bound < self.cutoff(upper_bound):
            return None if self.target is None else Status.CONVERGED
        is_trivial = lower_bound <= 0.0 and self.exact is not None
        if is_trivial and not self.is_exact(upper_bound):
            return Status.CONVERGED
        return Status.OPTIMAL

    def tightened(self, share: float) -> Tolerance:
        """Return a tolerance that allows this share of the gap."""
        return replace(self, rel=share * self.rel, abs=share * self.abs)

    def scaled(self, factor: float) -> Tolerance:
        """Return the tolerance of the objective multiplied by `factor`."""
        exact = None if self.exact is None else factor * self.exact
        target = None if self.target is None else factor * self.target
        return Tolerance(self.rel, factor * self.abs, exact, target, factor * self.margin)


def proven_share(lower_bound: float, upper_bound: float) -> float:
    """Return the lower bound divided by the upper bound, between 0 and 1; 1 if both are 0."""
    if upper_bound <= 0.0:
        return 1.0
    return min(max(lower_bound / upper_bound, 0.0), 1.0) if math.isfinite(upper_bound) else 0.0
