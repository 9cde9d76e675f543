"""The one assembly of a search: a space, a bound over it, and a budget."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dcreg.search.bound import Bound
from dcreg.search.box import LongestEdge
from dcreg.search.branch_and_bound import Refine, branch_and_bound
from dcreg.search.budget import Budget
from dcreg.search.leaves import Leaves
from dcreg.search.outcome import Outcome


class Searchable(Protocol):
    """What a search asks of a parameter space."""

    axis_weights: np.ndarray

    def heed(self, stop: np.ndarray) -> None:
        """Look at ``stop[0]`` within all that takes long, and raise `Interrupted` once it is set."""
        ...

    def start(self, budget: Budget, enough: float) -> tuple[np.ndarray, float, int]:
        """A first incumbent: theta, objective, assignments spent. None below `enough` is sought."""
        ...

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Descent from `theta`: a better theta, its objective, assignments spent."""
        ...


def minimise(
    space: Searchable,
    bound: Bound,
    budget: Budget,
    *,
    gap_tol: float,
    start: tuple[np.ndarray, float] | None = None,
    refine: Refine | None = None,
    stage: str = "search",
    leaves: Leaves | None = None,
) -> Outcome:
    """Least objective over the roots of `bound`, to within `gap_tol`.

    Parameters
    ----------
    space : Searchable
        Gives the first incumbent, the descents, and the weights by which boxes are divided.
    bound : Bound
    budget : Budget
    gap_tol : float
        Absolute, in the units of the objective.
    start : (theta, value), optional
        A known parameter and its objective; default: what ``space.start`` finds.
    refine : callable, optional
        Descent in place of ``space.refine``.
    stage : str
        Name of this search in its events.
    leaves : Leaves, optional
        Collects the leaf boxes for a certificate.

    Returns
    -------
    Outcome
    """
    began, spent = budget.elapsed(), 0
    space.heed(budget.stop)
    if start is None:
        theta, value, spent = space.start(budget, gap_tol)
        start = theta, value
    found = branch_and_bound(
        bound,
        budget,
        branching=LongestEdge(space.axis_weights),
        gap_tol=gap_tol,
        refine=refine or space.refine,
        start=start,
        stage=stage,
        leaves=leaves,
    )
    found.n_assignments += spent
    found.time_s = budget.elapsed() - began
    return found
