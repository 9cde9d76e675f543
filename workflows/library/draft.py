"""A problem before it has a file: clouds, true pairs and origin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from data.sampling import reference_pose
from dcreg.problem import apply_pose
from workflows.disturb import SCALE_RANGE_2D, random_pose, seed_for, shuffle_target

DECIMALS = 6  # of the coordinates; a problem consists of the rounded numbers


@dataclass(frozen=True)
class Draft:
    """A problem as its construction makes it.

    Attributes
    ----------
    name, family, title, origin : str
    source : (n, d) array
    target : (m, d) array
    pairs : (k, 2) int array
        True pairs.
    n_inliers : int
    unit : str
        The meaning of a length of 1.
    planted_optima : int, optional
        Number of distinct optima, if the construction determines it.
    scale_range : (low, high)
    recipe : dict, optional
        How to fetch the points, if they are third-party data.
    """

    name: str
    family: str
    title: str
    origin: str
    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray
    n_inliers: int
    unit: str = "longest side of the shape"
    planted_optima: int | None = None
    scale_range: tuple[float, float] = (1.0, 1.0)
    recipe: dict[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> str:
        return "similarity2d" if self.source.shape[1] == 2 else "rigid3d"

    def truth(self) -> np.ndarray:
        """Return the pose fitted to the true pairs."""
        return reference_pose(self.source, self.target, self.pairs, self.scale_range)


def moved(
    name: str,
    family: str,
    title: str,
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    *,
    n_inliers: int | None = None,
    planted_optima: int | None = None,
    is_scaled: bool = True,
) -> Draft:
    """Apply a random pose to the target of a construction, shuffle it and round both clouds.

    Parameters
    ----------
    name, family, title, source, target, pairs
        As in `Draft`.
    n_inliers : int, optional
        Default: the number of true pairs.
    planted_optima : int, optional
    is_scaled : bool
        Whether the scale of a 2D pose is free.
    """
    dim = source.shape[1]
    pose = random_pose(dim, np.random.default_rng(seed_for("library pose", name)))
    is_free = is_scaled and dim == 2
    if dim == 2 and not is_free:
        pose[:2, :2] /= np.sqrt(np.linalg.det(pose[:2, :2]))
    order = np.random.default_rng(seed_for("library order", name))
    shuffled, pairs = shuffle_target(apply_pose(pose, target), pairs, order)
    return Draft(
        name, family, title, "constructed by workflows/library",
        source.round(DECIMALS), shuffled.round(DECIMALS), pairs, n_inliers or len(pairs),
        planted_optima=planted_optima, scale_range=SCALE_RANGE_2D if is_free else (1.0, 1.0),
    )  # fmt: skip
