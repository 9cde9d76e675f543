"""The user's own pairs of clouds: a folder per pair, with both clouds and the pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import field_validator

from data.contract import Axis, Card, DataError, RawInstance, RecordedDataset
from data.parameters import Length, Parameters, Points, parameters_of, place_of
from data.sampling import farthest_points, mutual_nearest
from dcreg.io import read_points
from dcreg.problem import InputError, apply_pose, scale_of

MAX_POINTS = 200  # of a cloud, by default
SCALE_RANGE_2D = (0.5, 1.5)  # the default
RIGID = 1e-3  # tolerance of the check that the pose has a rotation


class PairParameters(Parameters):
    folder: str
    tolerance: Length
    n_points: Points = MAX_POINTS
    scale_range: tuple[Length, Length] = SCALE_RANGE_2D

    @field_validator("scale_range")
    @classmethod
    def _is_a_range(cls, given: tuple[float, float]) -> tuple[float, float]:
        if given[0] > given[1]:
            raise ValueError(f"{list(given)}; give two numbers, 0 < low <= high")
        return given


class CloudPairs(RecordedDataset):
    """One shape per folder ``<pair>/`` with ``source.*``, ``target.*``, ``pose.txt``; one test, ``pair``.

    The clouds are in any format that ``dcreg register`` reads. The pose maps source to target, as rows
    of its homogeneous matrix; it is a similarity in 2D and rigid in 3D. True pairs are mutual nearest
    neighbours at the pose, at most ``tolerance`` apart.

    Card parameters: ``folder`` (of the pairs; relative to the card), ``tolerance`` in the clouds' unit;
    optionally ``n_points`` (larger clouds are downsampled to it; default 200) and, in 2D,
    ``scale_range`` (default 0.5 to 1.5).
    """

    def __init__(self, card: Card) -> None:
        super().__init__(card)
        self.where = place_of(card)
        if isinstance(card.dim, dict):
            raise DataError(f"{self.where}: dim: {card.dim!r}; give 2 or 3, the same for all pairs")
        self.parameters = parameters_of(card, PairParameters)
        self.folder = (card.folder / Path(self.parameters.folder).expanduser()).resolve()

    def shapes(self) -> list[str]:
        if not self.folder.is_dir():
            raise DataError(
                f"{self.where}: parameters.folder: {self.folder} is not a folder; correct it"
            )
        names = sorted(path.parent.name for path in self.folder.glob("*/pose.txt"))
        for path in sorted(self.folder.glob("*/source.*")):
            if path.parent.name not in names:
                raise DataError(
                    f"{path.parent}: no pose.txt; add it, the homogeneous matrix from source to target, "
                    f"or move the folder out of {self.folder}"
                )
        if not names:
            raise DataError(
                f"{self.folder}: no pairs; add folders with source.*, target.* and pose.txt"
            )
        return names

    def tests(self) -> dict[str, Axis]:
        return {"pair": Axis(levels=(0.0,), values=(0.0,), label="-", n_trials=1)}

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        """Return the paths of source, target and pose."""
        place = self.folder / shape
        found = []
        for role in ("source", "target"):
            paths = [path for path in sorted(place.glob(f"{role}.*")) if path.is_file()]
            if len(paths) != 1:
                raise DataError(f"{place}: {len(paths)} files {role}.*; keep exactly one")
            found += paths
        return [*found, place / "pose.txt"]

    def size_note(self, n_points: int | None) -> str:
        most = n_points or self.parameters.n_points
        return (
            f"{self.name}: clouds of more than {most} points are reduced to {most}; to change this, set "
            f"n_points in the config, or in parameters of {self.where}"
        )

    def local_files(self) -> list[Path]:
        return sorted(path for path in self.folder.glob("*/*") if path.is_file())

    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        *paths, pose_path = self.files(shape, test, level, trial)
        source, target = (self._cloud(path, n_points or self.parameters.n_points) for path in paths)
        T_true, scale_range = self._pose(pose_path)
        pairs = mutual_nearest(apply_pose(T_true, source), target, self.parameters.tolerance)
        if len(pairs) <= self.dim(shape):
            from scipy.spatial import cKDTree  # takes long to load; a plan needs no points

            distance, _ = cKDTree(target).query(apply_pose(T_true, source))
            raise DataError(
                f"{pose_path}: only {len(pairs)} points of the {len(source)} and {len(target)} lie "
                f"within tolerance {self.parameters.tolerance:g} of each other at this pose (median "
                f"distance {np.median(distance):.3g}). It must map source to target; else "
                f"raise tolerance in {self.where}, or n_points"
            )
        return RawInstance(source, target, pairs, T_true, scale_range)

    def _cloud(self, path: Path, n_points: int) -> np.ndarray:
        try:
            points = read_points(path)
        except (InputError, OSError) as error:
            raise DataError(f"{path}: {error}") from error
        if points.shape[1] != self.card.dim:
            raise DataError(
                f"{path}: points have {points.shape[1]} coordinates, but dim is {self.card.dim} in "
                f"{self.where}; correct one of them"
            )
        return points[farthest_points(points, min(n_points, len(points)))]

    def _pose(self, path: Path) -> tuple[np.ndarray, tuple[float, float]]:
        """Return the checked pose and the range of scales given to solvers."""
        d = self.dim("")
        try:
            T = np.loadtxt(path, ndmin=2)
        except (ValueError, OSError) as error:
            raise DataError(f"{path}: not a matrix of numbers ({error}); correct it") from error
        shape = (d + 1, d + 1)
        if T.shape != shape or not np.isfinite(T).all() or not np.allclose(T[d], np.eye(d + 1)[d]):
            raise DataError(
                f"{path}: must be a homogeneous matrix of shape {shape} with the last row "
                f"{'0 ' * d}1, but has shape {T.shape}; correct it"
            )
        linear = T[:d, :d]
        scale = scale_of(T)
        low, high = (1.0, 1.0) if d == 3 else self.parameters.scale_range
        if not np.allclose(
            linear @ linear.T, scale**2 * np.eye(d), atol=RIGID * max(1.0, scale**2)
        ):
            raise DataError(
                f"{path}: its {d} x {d} part is not a rotation times a scale; correct it"
            )
        if np.linalg.det(linear) < 0:
            raise DataError(f"{path}: the pose contains a reflection; give one without")
        if not low - RIGID <= scale <= high + RIGID:
            remedy = (
                "rescale a cloud" if d == 3 else f"widen parameters.scale_range in {self.where}"
            )
            raise DataError(f"{path}: its scale is {scale:.4g}, not {low:g} to {high:g}; {remedy}")
        return T, (low, high)
