"""The published bound of DC-Reg: tangent at the centre of a box, one k-assignment per vertex.

LB(M) = min over the vertices v of M of min_P sum p_ij [E_ij(v) - R_i(v - theta0)], where R_i is the gap
of the tangent of the convex part at the centre theta0.
"""

from __future__ import annotations

import abc
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import numpy as np

from baselines._shared.algorithm1 import Bounded
from baselines._shared.kernels.published import linearised_values
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box

S = TypeVar("S", bound=FeatureSpace)


def vertices_of(box: Box) -> np.ndarray:
    """Return the (2^d, d) vertices of a box; each differs from the previous one in one coordinate."""
    dim = box.lower.size
    numbers = np.arange(2**dim)
    gray = numbers ^ (numbers >> 1)
    upper = (gray[:, None] >> np.arange(dim)) & 1
    return np.where(upper == 1, box.upper, box.lower)


class PublishedBound(abc.ABC, Generic[S]):
    """The published bound of boxes over a space; several threads bound both children at once."""

    def __init__(self, space: S, threads: int = 1) -> None:
        self.space = space
        self.n_assignments = 0
        self._pool = ThreadPoolExecutor(1) if threads > 1 else None

    def evaluate(self, boxes: list[Box]) -> list[Bounded]:
        """Bound each box.

        Raises
        ------
        dcreg.search.Interrupted
            If the stop flag of the space is set.
        """
        if self._pool is None or len(boxes) == 1:
            found = [self._bounded(box) for box in boxes]
        else:
            first = self._pool.submit(self._bounded, boxes[0])
            second = self._bounded(boxes[1])
            found = [first.result(), second]
        self.space.check()
        self.n_assignments += sum(count for _, count in found)
        return [bounded for bounded, _ in found]

    @abc.abstractmethod
    def _bounded(self, box: Box) -> tuple[Bounded, int]:
        """Return the bound of a box, and the number of assignments solved."""


class SimilarityBound(PublishedBound[Similarity2D]):
    """16 assignments per box, and one for the objective at the minimising vertex."""

    def _bounded(self, box: Box) -> tuple[Bounded, int]:
        vertices = vertices_of(box)
        values = np.full(len(vertices), np.inf)
        linearised_values(self.space.clouds, vertices, box.centre, values)
        best = int(np.argmin(values))
        at_best = np.empty(1)
        self.space.objectives(vertices[best : best + 1], at_best)
        return Bounded(float(values[best]), vertices[best], float(at_best[0])), len(vertices) + 1


class NormBound(PublishedBound[Translation3D]):
    """8 assignments per box.

    R_i is the squared half-diagonal of the box for every row, so the objective at the minimising vertex
    is one of the values found. Norms are numbers on a line, where assignments are fast.
    """

    def _bounded(self, box: Box) -> tuple[Bounded, int]:
        vertices = vertices_of(box)
        values = np.full(len(vertices), np.inf)
        self.space.objectives(vertices, values)
        best = int(np.argmin(values))
        missed = self.space.n_inliers * float(box.half_widths @ box.half_widths)
        return Bounded(float(values[best]) - missed, vertices[best], float(values[best])), len(
            vertices
        )


def published_bound(space: FeatureSpace, threads: int = 1) -> SimilarityBound | NormBound:
    """Return the published bound over a space."""
    if isinstance(space, Similarity2D):
        return SimilarityBound(space, threads)
    assert isinstance(space, Translation3D)
    return NormBound(space, threads)
