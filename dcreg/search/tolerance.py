"""The gap at which a search stops, and what the bounds then prove."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dcreg.status import Status


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
        An upper bound of at most this counts as 0, so that no lower bound is needed. A larger one is not
        proven by a lower bound of 0, which holds for every sum of squares: a search whose gap closes
        without more has converged. Default: the gap alone decides, as in Algorithm 1.
    """

    rel: float = 0.0
    abs: float = 0.0
    exact: float | None = None

    @property
    def enough(self) -> float:
        """An upper bound of at most this ends the search, whatever the lower bound."""
        return max(self.abs, self.exact or 0.0)

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
        """Return the lower bound at which the gap is closed; it falls with the upper bound."""
        return upper_bound - self.allowed(upper_bound)

    def status(self, lower_bound: float, upper_bound: float) -> Status | None:
        """Return the status of a search with these bounds; None if the gap is open."""
        if lower_bound < self.cutoff(upper_bound):
            return None
        is_trivial = lower_bound <= 0.0 and self.exact is not None
        if is_trivial and not self.is_exact(upper_bound):
            return Status.CONVERGED
        return Status.OPTIMAL

    def tightened(self, share: float) -> Tolerance:
        """Return a tolerance that allows this share of the gap."""
        return Tolerance(share * self.rel, share * self.abs, self.exact)

    def scaled(self, factor: float) -> Tolerance:
        """Return the tolerance of the objective multiplied by `factor`."""
        exact = None if self.exact is None else factor * self.exact
        return Tolerance(self.rel, factor * self.abs, exact)


def proven_share(lower_bound: float, upper_bound: float) -> float:
    """Return the lower bound divided by the upper bound, between 0 and 1; 1 if both are 0."""
    if upper_bound <= 0.0:
        return 1.0
    return min(max(lower_bound / upper_bound, 0.0), 1.0) if math.isfinite(upper_bound) else 0.0
