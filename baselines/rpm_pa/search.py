"""Polyhedral annexation: an inner polytope of the level set grows until it contains all matchings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from baselines._shared.concave import ConcaveSearch, Support
from baselines._shared.cubes import OutOfTimeError
from baselines.rpm_pa.kernels import extensions, test_facets, value_at
from baselines.rpm_pa.polytope import Polytope
from dcreg.status import Status

_CLOSED = 1e-9
# The exact variant stops when no matching can be better by the tolerance. The level uses slightly
# less, so that the bound of a closed facet reaches the tolerance despite rounding.
_SHARE_OF_TOLERANCE = 0.9
_BATCH = 1000  # facets tested between two checks of the budget, fewer for large problems
# Maximum component of a vertex, in ranges of the statistics, if the level set is unbounded.
_REACH = 100.0


@dataclass
class Search(ConcaveSearch):
    """Annexation facet by facet; `epsilon0` is the option of the card.

    All matchings lie in the polytope D spanned by their points ``(u, L)``. A facet's cone is closed
    when D does not leave the polytope there: since F is concave, no matching of the cone is then below
    the level. Until then ``min F`` over the simplex of the facet, stretched to contain D, is a lower
    bound.
    """

    epsilon0: float

    def __post_init__(self) -> None:
        clouds = self.reduced.clouds
        self.batch = int(np.clip(300_000 // (len(clouds.source) * len(clouds.target)), 1, _BATCH))
        self.support = Support(self.reduced.incumbent, with_fixed=True)

    @property
    def exact(self) -> bool:
        return self.epsilon0 == 0.0

    @property
    def level(self) -> float:
        """The polytope stays inside ``F >= level``."""
        share = _SHARE_OF_TOLERANCE if self.exact else 1e-6
        # the inner point is a mean of points of matchings, so no worse than the incumbent up to rounding
        return min(self.upper_bound, self.at_inner) - share * self.gap_tol - 1e-12

    def run(self) -> None:
        try:
            try:
                self.z = self.support.coordinates()
            finally:
                self.n_assignments += self.support.n_assignments
                self.record()  # the first incumbent
            self.dim = self.z.dim
            if self.dim == 0:  # all matchings have the value of the incumbent
                self.lower_bound = self.upper_bound
                self.status = Status.OPTIMAL
            else:
                self._annex_all()
        except OutOfTimeError:
            self.status = Status.TIME_LIMIT
        self.record()

    def _annex_all(self) -> None:
        points = np.unique(self.support.points, axis=0)
        self.inner = self._z(points).mean(axis=0)
        self.at_inner = value_at(self.reduced.clouds, self.z.origin, self.z.axes, self.inner)
        self.rays = [*np.eye(self.dim), -np.ones(self.dim)]
        polytope = self._rebuilt()
        while self.status is None:
            self.lower_bound = max(self.lower_bound, min(polytope.lower_bound, self.upper_bound))
            self.record(polytope.n_facets)
            untested = polytope.untested(self.batch)
            # growing copies the arrays, and Python uses half of the worker's memory
            self.status = self.ended(polytope.nbytes, 0.2)
            if self.status is not None:
                return
            if len(untested):
                if self._test(polytope, untested):
                    polytope = self._rebuilt()
            elif not self._annex_farthest(polytope):
                self.status = Status.CONVERGED

    def _test(self, polytope: Polytope, facets: np.ndarray) -> bool:
        """Compute how far D exceeds each facet; return whether a better matching was found."""
        col_of = np.empty(len(self.reduced.clouds.source), np.int64)
        passage, farthest, bounds, best = test_facets(
            self.reduced.clouds, self.z.origin, self.z.axes, self.z.inverse, self.inner,
            polytope.vertices, polytope.members[facets], polytope.normals[facets], col_of,
        )  # fmt: skip
        self.n_nodes += len(facets)
        self.n_assignments += len(facets)
        polytope.bounds[facets] = np.maximum(polytope.bounds[facets], bounds)
        passage[polytope.bounds[facets] >= self.upper_bound - self.gap_tol] = 0.0
        polytope.passage[facets], polytope.farthest[facets] = passage, farthest
        return self.reduced.incumbent.beaten_by(best) and self.reduced.incumbent.offer(col_of)

    def _annex_farthest(self, polytope: Polytope) -> bool:
        """Annex the point by which D exceeds the polytope most; return False if no facet is exceeded."""
        while True:
            facet = polytope.most_passed()
            if polytope.passage[facet] <= 1.0 + self.dim * self.epsilon0 + _CLOSED:
                return False
            if self._annex(polytope, polytope.farthest[facet].copy()):
                return True
            polytope.passage[facet] = 0.0  # degenerate: its bound stays

    def _annex(self, polytope: Polytope, ray: np.ndarray) -> bool:
        """Add the extension of a ray; a ray in degenerate position is perturbed."""
        generator = np.random.default_rng(len(polytope.vertices))
        for shake in (0.0, 1e-7, 1e-5, 1e-3):
            moved = ray + shake * generator.standard_normal(self.dim)
            if polytope.annex(self._extended(moved[None])[0]):
                self.rays.append(moved)
                return True
        return False

    def _rebuilt(self) -> Polytope:
        """Rebuild the polytope of all rays at the new level after the incumbent improved."""
        extended = self._extended(np.array(self.rays))
        polytope = Polytope(extended[: self.dim + 1], self.lower_bound)
        for vertex in extended[self.dim + 1 :]:
            if self.budget.is_over:
                raise OutOfTimeError
            polytope.annex(vertex)
        return polytope

    def _extended(self, rays: np.ndarray) -> np.ndarray:
        clouds, z = self.reduced.clouds, self.z
        return extensions(clouds, z.origin, z.axes, self.inner, rays, self.level, _REACH)

    def _z(self, points: np.ndarray) -> np.ndarray:
        return (points - self.z.origin) @ self.z.inverse.T
