"""Recipes: problems whose points come from third parties, and are fetched when they are needed."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data.contract import DataError, PrototypeDataset, RawInstance, RecordedDataset
from data.registry import dataset
from data.sampling import farthest_points, mutual_nearest, reference_pose

DECIMALS = 6


class Recipe(BaseModel):
    """Two clouds from a dataset of ``data/``.

    A recorded dataset gives an instance. A shape is sampled in farthest-point order; the points with even
    ranks are the source and those with odd ranks the target, like two scans of one surface.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    dataset: str
    shape: str
    test: str = ""
    level: float = 0.0
    trial: int = Field(default=0, ge=0)
    n_points: int | None = Field(default=None, ge=3)  # per cloud

    def instance(self) -> RawInstance:
        """Return the clouds, rounded to six decimals, and the true pairs.

        Raises
        ------
        DataError
            If the files cannot be fetched.
        """
        found = dataset(self.dataset)
        if isinstance(found, RecordedDataset):
            raw = found.instance(self.shape, self.test, self.level, self.trial, self.n_points)
            source, target = raw.source.round(DECIMALS), raw.target.round(DECIMALS)
            return RawInstance(source, target, raw.pairs, raw.T_true, raw.scale_range)
        if not isinstance(found, PrototypeDataset) or self.n_points is None:
            raise DataError(f"recipe: {self.dataset} is a dataset of shapes; give n_points")
        points = found.prototype(self.shape, 2 * self.n_points)
        ranked = points[farthest_points(points, len(points))].round(DECIMALS)
        source, target = ranked[::2], ranked[1::2][:, [1, 2, 0]]  # a rotation of 120 degrees
        pairs = mutual_nearest(source[:, [1, 2, 0]], target, 1.0)
        pose = reference_pose(source, target, pairs, (1.0, 1.0))
        return RawInstance(source, target, pairs, pose, (1.0, 1.0))

    def clouds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return source and target."""
        raw = self.instance()
        return raw.source, raw.target
