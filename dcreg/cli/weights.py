"""Options for the weights of points."""

from __future__ import annotations

from dataclasses import dataclass

import dcreg
from dcreg.cli.options import CloudFiles


@dataclass
class WeightFiles:
    """Weights of the points.

    Attributes
    ----------
    source_weights_path : FILE
        Weights of the source points, such as inverse variances: one positive number per line, or .npy.
    target_weights_path : FILE
        Weights of the target points.
    weight_distance : D
        Length in units of the target: a pair of weight w (at most 1) costs w * residual^2 +
        (1 - w) * D^2. Required unless only one cloud has weights and all its points are matched.
    """

    source_weights_path: str | None = None
    target_weights_path: str | None = None
    weight_distance: float | None = None

    def settings(self, clouds: CloudFiles) -> dcreg.PointWeights | None:
        """Return the weights, if there are any; the files of `clouds` have been read."""
        paths = {"source": self.source_weights_path, "target": self.target_weights_path}
        given = {name: dcreg.read_weights(path) for name, path in paths.items() if path}
        if clouds.rows is not None:
            kept = {"source": clouds.rows.source, "target": clouds.rows.target}
            given = {name: kept[name].valid(each, paths[name]) for name, each in given.items()}
        if not given and self.weight_distance is not None:
            raise dcreg.InputError(
                "--weight-distance: there are no weights; give --source-weights or --target-weights"
            )
        return dcreg.PointWeights(**given, distance=self.weight_distance) if given else None
