"""Options for the weights and attributes of points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dcreg
from dcreg.cli.options import CloudFiles

if TYPE_CHECKING:  # NumPy is loaded with the first file, not for --help
    import numpy as np


@dataclass
class CostFiles:
    """Weights and attributes of the points.

    Attributes
    ----------
    source_weights_path : FILE
        Weights of the source points, such as inverse variances: one positive number per line, or .npy.
    target_weights_path : FILE
        Weights of the target points.
    weight_distance : D
        Length in units of the target: a pair of weight w (at most 1) costs w * residual^2 +
        (1 - w) * D^2. Required unless only one cloud has weights and all its points are matched.
    source_attributes_path : FILE
        Attributes of the source points, such as intensities: one row of numbers per line, or .npy. From a
        .ply or .pcd file, the colours (0 to 1) are read or, if there are none, the intensities.
    target_attributes_path : FILE
        Attributes of the target points.
    attribute_scale : S
        Length in units of the target: a pair with the attribute distance d costs residual^2 + S^2 * d^2.
    """

    source_weights_path: str | None = None
    target_weights_path: str | None = None
    weight_distance: float | None = None
    source_attributes_path: str | None = None
    target_attributes_path: str | None = None
    attribute_scale: float | None = None

    @property
    def paths(self) -> list[str]:
        """The files that are given."""
        weights = self.source_weights_path, self.target_weights_path
        return [
            path
            for path in (*weights, self.source_attributes_path, self.target_attributes_path)
            if path is not None
        ]

    def settings(self, clouds: CloudFiles) -> dict[str, Any]:
        """Return the arguments of `dcreg.register`; the files of `clouds` have been read."""
        return {"weights": self._weights(clouds), "attributes": self._attributes(clouds)}

    def _weights(self, clouds: CloudFiles) -> dcreg.PointWeights | None:
        paths = {"source": self.source_weights_path, "target": self.target_weights_path}
        given = {
            name: _valid(dcreg.read_weights(path), name, path, clouds)
            for name, path in paths.items()
            if path
        }
        if not given and self.weight_distance is not None:
            raise dcreg.InputError(
                "--weight-distance: there are no weights; give --source-weights or --target-weights"
            )
        return dcreg.PointWeights(**given, distance=self.weight_distance) if given else None

    def _attributes(self, clouds: CloudFiles) -> dcreg.Attributes | None:
        paths = {"source": self.source_attributes_path, "target": self.target_attributes_path}
        options = {
            **{f"--{name}-attributes": path for name, path in paths.items()},
            "--attribute-scale": self.attribute_scale,
        }
        given = [name for name, value in options.items() if value is not None]
        if not given:
            return None
        if missing := [name for name in options if name not in given]:
            raise dcreg.InputError(
                f"{missing[0]}: missing; {given[0]} needs the attributes of both clouds and their scale"
            )
        for name, path in paths.items():
            _check_no_coordinates(f"--{name}-attributes", path or "", clouds.names[name])
        sides = {
            name: _valid(dcreg.read_attributes(path), name, path, clouds)
            for name, path in paths.items()
            if path is not None
        }
        return dcreg.Attributes(**sides, scale=self.attribute_scale)


def _check_no_coordinates(option: str, path: str, cloud: str) -> None:
    """Refuse the file of a cloud as its attributes if all its columns would be read."""
    is_table = Path(path).suffix.lower() in (".txt", ".csv", ".npy")
    if is_table and Path(path).resolve() == Path(cloud).resolve():
        raise dcreg.InputError(
            f"{option}: {path} is the cloud itself, so its coordinates would count as attributes; give "
            "a file with only the attributes"
        )


def _valid(values: np.ndarray, name: str, path: str, clouds: CloudFiles) -> np.ndarray:
    """Return the values of the points of one cloud that are searched."""
    rows = clouds.rows
    return values if rows is None else getattr(rows, name).valid(values, path)
