"""Photographs as point sets: edge points, also of an image rotated by 180 degrees."""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from data.contract import Axis, Card, DataError, RawInstance, RecordedDataset
from data.fetch import UnavailableError, cache_root
from data.parameters import Count, Length, Parameters, Points, parameters_of
from data.sampling import farthest_points, mutual_nearest
from dcreg.problem import apply_pose

SHARE = 0.9  # of the smaller set: n_inliers given to methods
TOLERANCE = 0.02  # of the longest side: maximum distance of pairs at the reference pose
SCALE_RANGE = (0.5, 1.5)
PICTURES = {".jpg", ".jpeg", ".png"}


@lru_cache(maxsize=32)
def edge_points(path: Path, sigma: float, n_points: int, parity: int | None = None) -> np.ndarray:
    """Return `n_points` Canny edge points of an image, by farthest-point sampling; x right, y down.

    Parameters
    ----------
    path : Path
    sigma : float
        Standard deviation of the Gaussian filter, in pixels.
    n_points : int
    parity : 0 or 1, optional
        Use only pixels with x + y even or odd: two sets of one image without a common point.

    Raises
    ------
    DataError
        The image cannot be read, or has fewer edge points.
    """
    y, x = np.nonzero(_edges(grey(path), sigma))
    points = np.column_stack([x, y]).astype(float)
    if parity is not None:
        points = points[(x + y) % 2 == parity]
    if len(points) < n_points:
        raise DataError(
            f"{path}: {len(points)} edge points at sigma {sigma:g}, fewer than n_points={n_points}; "
            "lower n_points or sigma"
        )
    return points[farthest_points(points, n_points)]


def half_turn(path: Path) -> np.ndarray:
    """Return the pose that rotates an image by 180 degrees about its centre."""
    height, width = grey(path).shape
    return np.array([[-1.0, 0.0, width - 1], [0.0, -1.0, height - 1], [0.0, 0.0, 1.0]])


def given_pairs(source: np.ndarray, target: np.ndarray) -> int:
    """Return n_inliers for photographs, as in the paper."""
    return round(SHARE * min(len(source), len(target)))


def near_pairs(T_true: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return points that coincide at the reference pose; the evaluation does not use them."""
    reach = TOLERANCE * float(np.ptp(target, axis=0).max())
    return mutual_nearest(apply_pose(T_true, source), target, reach)


class PhotographParameters(Parameters):
    folder: str
    layout: Literal["voc", "caltech"]
    shapes: Annotated[list[str], Field(min_length=1)]
    n_trials: Count
    n_points: Points
    sigma: Length


class Photographs(RecordedDataset):
    """A folder of VOC2007 or Caltech-256: each photograph against itself, rotated by 180 degrees.

    Source and target use different pixels. Test ``turned``, level 0; a shape is a class, trial k its
    k-th photograph.

    Card parameters: ``folder`` (below the dataset's folder in the cache), ``layout`` (``voc`` or
    ``caltech``), ``shapes``, ``n_trials``, ``n_points``, ``sigma``.
    """

    def __init__(self, card: Card) -> None:
        super().__init__(card)
        self.parameters = parameters_of(card, PhotographParameters)

    def shapes(self) -> list[str]:
        return list(self.parameters.shapes)

    def tests(self) -> dict[str, Axis]:
        return {"turned": Axis((0.0,), (0.0,), "-", self.parameters.n_trials)}

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        listed = self._listed(shape)
        if trial >= len(listed):
            raise DataError(
                f"dataset {self.name}: {shape} has {len(listed)} photographs, so there is no trial "
                f"{trial}; lower trials"
            )
        return [listed[trial]]

    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        (path,) = self.files(shape, test, level, trial)
        count = n_points or self.parameters.n_points
        sigma, turn = self.parameters.sigma, half_turn(path)
        source = apply_pose(turn, edge_points(path, sigma, count, parity=1))
        target = edge_points(path, sigma, count, parity=0).copy()
        pairs = near_pairs(turn, source, target)
        return RawInstance(
            source, target, pairs, turn, SCALE_RANGE, n_inliers=given_pairs(source, target)
        )

    def _listed(self, shape: str) -> list[Path]:
        """Return the photographs of a class, in the order of the dataset's own lists."""
        place = cache_root() / self.name / self.parameters.folder
        if not place.is_dir():
            raise UnavailableError(
                f"dataset {self.name}: no folder {place}. {self.card.notes.strip()}"
            )
        if self.parameters.layout == "caltech":
            folders = [path for path in place.iterdir() if path.name.endswith(f".{shape}")]
            found = sorted(path for folder in folders for path in folder.iterdir())
            return [path for path in found if path.suffix.lower() in PICTURES]
        names = place / "ImageSets" / "Main" / f"{shape}_trainval.txt"
        if not names.is_file():
            raise DataError(f"{names}: no such list; put the whole folder {place.name} there")
        rows = [line.split() for line in names.read_text(encoding="utf-8").splitlines()]
        with_object = [row[0] for row in rows if len(row) == 2 and row[1] == "1"]
        return [place / "JPEGImages" / f"{name}.jpg" for name in with_object]


@lru_cache(maxsize=4)
def grey(path: Path) -> np.ndarray:
    """Return a photograph as grey values between 0 and 1."""
    from skimage import color, io

    try:
        # from memory: on a broken picture imageio leaves files open
        picture = io.imread(BytesIO(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a readable image ({error})") from error
    return color.rgb2gray(picture[..., :3]) if picture.ndim == 3 else picture / 255.0


def _edges(picture: np.ndarray, sigma: float) -> np.ndarray:
    from skimage.feature import canny

    return canny(picture, sigma=sigma)
