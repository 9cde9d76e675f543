"""What a search asks of a lower bounding function: the part that the paper's comparison exchanges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dcreg.search.box import Box


@dataclass
class Evaluation:
    """What a bound says of B boxes.

    Attributes
    ----------
    lower_bounds : (B,) array
        Valid for every admissible theta of the box, or at least for every global optimum in it, which is
        all that a search needs; +inf when the box holds no admissible theta.
    thetas : (B, d) array
        One parameter per box worth knowing, admissible or not.
    values : (B,) array
        Upper bounds on the objective at `thetas`; +inf where theta is not admissible.
    hints : (B, h) array, optional
        What the bound wants to be told again of the boxes that are made from these: a start for its work
        on them, on which the validity of what it says does not depend.
    """

    lower_bounds: np.ndarray
    thetas: np.ndarray
    values: np.ndarray
    hints: np.ndarray | None = None


class Bound(Protocol):
    """A lower bounding function over the boxes that bisection makes of `roots`."""

    @property
    def roots(self) -> list[Box]:
        """Together they hold the region searched."""
        ...

    @property
    def round_size(self) -> int:
        """Boxes bounded between two readings of the clock, at most."""
        ...

    @property
    def n_assignments(self) -> int:
        """Exact assignments solved so far."""
        ...

    def evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, *, thorough: bool = False
    ) -> Evaluation:
        """Bound B boxes (rows of `lower`, `upper`).

        Above `cutoff` precision is of no use, and where the cutoff is out of reach the box is divided
        anyway, so that a bound may stop early; with `thorough` it does its best on every box. One that
        gives hints takes them too, as ``hints=``: (B, h), of the boxes that these were made from.
        """
        ...
