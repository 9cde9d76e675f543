"""What every transformation model offers to bounds and search."""

from __future__ import annotations

import abc

import numpy as np

from dcreg.box import Box
from dcreg.kernels import vertices

# Descents for the first incumbent: enough for a good upper bound, cheap beside any search.
N_DESCENTS = 6


class Model(abc.ABC):
    """A parameterised family of poses over a normalised problem.

    Attributes
    ----------
    kind : int
        Selects the compiled kernels (`dcreg.kernels.features`).
    source : (n, d) array
        Normalised source points.
    target_features : (q, m) or (q + n, m) array
        What the moved source is compared with: target points in 2D, their norms in norm space. Where
        not every pair is feasible, the prices of the pairs follow (`with_prices`).
    n_inliers : int
    axis_weights : (dim,) array
        RMS motion of the source per unit step along each axis.
    scope : str
        What a certificate over this model speaks of.
    """

    kind: int
    source: np.ndarray
    target_features: np.ndarray
    n_inliers: int
    axis_weights: np.ndarray
    scope: str
    identity: np.ndarray  # the pose that moves nothing

    @abc.abstractmethod
    def start_box(self) -> Box:
        """A box that holds every global minimiser."""

    @abc.abstractmethod
    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        """Which of (B, dim) parameters are poses of the family."""

    @abc.abstractmethod
    def touches(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Which of B boxes may hold an admissible parameter (False only when surely none)."""

    @abc.abstractmethod
    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and closed-form fit from `theta`: admissible theta, objective, work."""

    @abc.abstractmethod
    def seeds(self) -> np.ndarray:
        """(S, dim) parameters spread over the family, to start descents from."""

    def first_incumbent(self) -> tuple[np.ndarray, float, int]:
        """The best of a few descents from the most promising seeds: theta, objective, work."""
        seeds = self.seeds()
        values = np.empty(len(seeds))
        spent = vertices.objectives(
            self.kind, self.source, self.target_features, self.n_inliers, seeds, values
        )
        descents = [
            self.refine(seed) for seed in seeds[np.argsort(values, kind="stable")[:N_DESCENTS]]
        ]
        theta, value, _ = min(descents, key=lambda descent: descent[1])
        return theta, value, spent + sum(descent[2] for descent in descents)

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """E(theta) and the column matched to every source row (-1: none)."""
        value, col_of = vertices.objective(
            self.kind, self.source, self.target_features, self.n_inliers, theta
        )
        return float(value), col_of


def with_prices(
    features: np.ndarray, candidates: np.ndarray | None, n_inliers: int, reach: float
) -> np.ndarray:
    """`features` of the target, followed by prohibitive prices of the pairs that are not feasible.

    No residual of an admissible pose exceeds ``2 sqrt(2) reach``, so one such pair costs more than any
    matching without.
    """
    if candidates is None:
        return np.ascontiguousarray(features)
    price = 16.0 * n_inliers * reach**2
    return np.ascontiguousarray(np.vstack([features, np.where(candidates, 0.0, price)]))


def mean_of_largest(values: np.ndarray, count: int) -> float:
    """Mean of the `count` largest numbers: the most a mean over `count` of them can be."""
    return float(np.sort(values)[-count:].mean())


def largest_subset_mean(points: np.ndarray, count: int, n_directions: int = 64) -> float:
    """An upper bound on ``|mean of any `count` points|`` in the plane.

    The support function of all subset means is the mean of the largest projections; sampled
    directions miss the worst one by at most half their spacing.
    """
    angles = np.arange(n_directions) * (2 * np.pi / n_directions)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    projections = np.sort(points @ directions, axis=0)[-count:].mean(axis=0)
    return float(max(projections.max(), 0.0) / np.cos(np.pi / n_directions))


def radius(points: np.ndarray) -> float:
    """Greatest distance of any point from the origin."""
    return float(np.sqrt((points**2).sum(axis=1)).max())
