"""Axis-parallel boxes of parameters, the regions that branch and bound divides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Box:
    """``lower <= theta <= upper``, componentwise; an axis may have zero width."""

    lower: np.ndarray
    upper: np.ndarray

    def __post_init__(self) -> None:
        if self.lower.shape != self.upper.shape or not (self.lower <= self.upper).all():
            raise ValueError(f"not a box: lower {self.lower}, upper {self.upper}")

    @property
    def dim(self) -> int:
        return self.lower.size

    @property
    def centre(self) -> np.ndarray:
        return 0.5 * (self.lower + self.upper)

    @property
    def half_widths(self) -> np.ndarray:
        return 0.5 * (self.upper - self.lower)

    def vertices(self) -> np.ndarray:
        """(2**d, d) corners, repeated where an axis has zero width."""
        choices = np.stack([self.lower, self.upper])
        bits = (np.arange(2**self.dim)[:, None] >> np.arange(self.dim)) & 1
        return choices[bits, np.arange(self.dim)]

    def sample(self, generator: np.random.Generator, size: int) -> np.ndarray:
        return generator.uniform(self.lower, self.upper, (size, self.dim))


class LongestEdge:
    """Bisect the edge that is longest after weighting each axis by the residual it causes.

    `weights` make axes comparable: a unit step of a rotation entry moves the source by about its RMS
    radius, a unit step of a translation by one.
    """

    def __init__(self, weights: np.ndarray) -> None:
        self.weights = np.asarray(weights, dtype=np.float64)

    def __call__(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(2 B, d) children of B boxes; the two halves of a box lie next to each other."""
        axis = np.argmax((upper - lower) * self.weights, axis=1)
        rows = np.arange(len(lower))
        middle = 0.5 * (lower[rows, axis] + upper[rows, axis])
        child_lower = np.repeat(lower, 2, axis=0)
        child_upper = np.repeat(upper, 2, axis=0)
        child_upper[2 * rows, axis] = middle
        child_lower[2 * rows + 1, axis] = middle
        return child_lower, child_upper
