"""From a prototype to a registration problem with known ground truth: disturbance, pose, shuffle.

All lengths are in units of the normalised prototype (bounding box centred at 0, longest side 1),
before the pose. The default levels and constants are assumed: the paper shows its axes, but does not
state them.

A disturbance is a pure function ``(prototype, level, rng, **options) -> Disturbed`` with an entry in
`DISTURBANCES`. `make_instance` serves prototypes and recorded datasets. The pose of an instance is
random; the reference for errors is `data.sampling.reference_pose`.

Random numbers are seeded by `seed_for`, a hash of the axes that a draw may depend on. The method is not
among them, so all methods receive the same instances. The pose depends on dataset, shape, test and trial,
not on the level: only the level changes along a curve of the report. The random numbers of the
disturbance depend on the level as well and are independent of the pose.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from data.contract import Dataset, PrototypeDataset, RawInstance, RecordedDataset
from data.sampling import reference_pose
from dcreg.problem import apply_pose, suggestion

SCALE_RANGE_2D = (0.5, 1.5)
MAX_SHIFT = 0.5  # translation per axis
WARP_WIDTH = 0.5  # of the radial basis functions of the deformation
BASE_DEFORMATION = 0.01  # coefficient of the deformation in the outlier tests; 0: none
MIXED_INFLATION = 1.2  # of the bounding box that mixed outliers fill
SEPARATE_CENTRE = 0.75  # of the outliers' box: -x for the source, +x for the target
SEPARATE_SIDE = 0.5
OCCLUSION_OUTLIERS = 0.5  # outlier ratio of the occlusion test


@dataclass(frozen=True)
class Disturbed:
    """Both sets before the pose. ``source[pairs[:, 0]]`` belongs to ``target[pairs[:, 1]]``."""

    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray


@dataclass(frozen=True)
class Disturbance:
    """A disturbance with its default levels and the name of its axis."""

    function: Callable[..., Disturbed]
    levels: tuple[float, ...]
    label: str

    def __call__(
        self, prototype: np.ndarray, level: float, rng: np.random.Generator, **options: Any
    ) -> Disturbed:
        return self.function(prototype, level, rng, **options)


# --- the five disturbances ---------------------------------------------------------------------


def deformation(
    prototype: np.ndarray, level: float, rng: np.random.Generator, *, width: float = WARP_WIDTH
) -> Disturbed:
    """Deform the target smoothly with coefficient `level`."""
    return _one_to_one(prototype, warp(prototype, level, rng, width))


def noise(prototype: np.ndarray, level: float, rng: np.random.Generator) -> Disturbed:
    """Add Gaussian noise with standard deviation `level` per axis to the target."""
    return _one_to_one(prototype, prototype + level * rng.standard_normal(prototype.shape))


def mixed_outliers(
    prototype: np.ndarray,
    level: float,
    rng: np.random.Generator,
    *,
    base_deformation: float = BASE_DEFORMATION,
) -> Disturbed:
    """Add uniform outliers to both sets: `level` times the number of prototype points in each."""
    target = warp(prototype, base_deformation, rng)
    count = _count(level, prototype)
    centre = (prototype.min(axis=0) + prototype.max(axis=0)) / 2
    side = MIXED_INFLATION * np.ptp(prototype, axis=0)
    return _with_outliers(
        _one_to_one(prototype, target),
        _uniform(rng, count, centre, side),
        _uniform(rng, count, centre, side),
    )


def separate_outliers(
    prototype: np.ndarray,
    level: float,
    rng: np.random.Generator,
    *,
    base_deformation: float = BASE_DEFORMATION,
) -> Disturbed:
    """Add as many outliers next to the shape: at -x in the source, at +x in the target."""
    target = warp(prototype, base_deformation, rng)
    return _with_separate_outliers(_one_to_one(prototype, target), _count(level, prototype), rng)


def occlusion_outliers(
    prototype: np.ndarray,
    level: float,
    rng: np.random.Generator,
    *,
    two_sided: bool = False,
    outlier_ratio: float = OCCLUSION_OUTLIERS,
    base_deformation: float = BASE_DEFORMATION,
) -> Disturbed:
    """Remove a share `level` of the points along a random direction, then add separate outliers.

    By default the target loses points (N (1 - level) inliers). With `two_sided` the source loses as many
    at its opposite end (N (1 - 2 level) inliers), which leaves none at level 0.5.
    """
    n, d = prototype.shape
    n_cut = _count(level, prototype)
    if n - (1 + two_sided) * n_cut < 2:
        raise ValueError(
            f"occlusion_outliers: level {level} leaves {max(0, n - (1 + two_sided) * n_cut)} of "
            f"{n} true pairs; use at most {0.4 if two_sided else 0.9}"
        )
    target = warp(prototype, base_deformation, rng)
    direction = rng.standard_normal(d)
    order = np.argsort(prototype @ direction, kind="stable")
    in_target = np.sort(order[: n - n_cut])
    in_source = np.sort(order[n_cut:]) if two_sided else np.arange(n)
    _, i, j = np.intersect1d(in_source, in_target, return_indices=True)
    cut = Disturbed(prototype[in_source], target[in_target], np.column_stack([i, j]))
    return _with_separate_outliers(cut, _count(outlier_ratio, prototype), rng)


_RATIOS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_SMALL = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05)
DISTURBANCES: dict[str, Disturbance] = {
    "deformation": Disturbance(deformation, _SMALL, "coefficient of the deformation"),
    "noise": Disturbance(noise, _SMALL, "noise σ, in longest sides"),
    "mixed_outliers": Disturbance(mixed_outliers, _RATIOS, "outliers per inlier, each set"),
    "separate_outliers": Disturbance(separate_outliers, _RATIOS, "outliers per inlier, each set"),
    "occlusion_outliers": Disturbance(occlusion_outliers, _RATIOS, "share of target occluded"),
}


# --- their parts -------------------------------------------------------------------------------


def warp(
    points: np.ndarray, coefficient: float, rng: np.random.Generator, width: float = WARP_WIDTH
) -> np.ndarray:
    """Return ``x + K g c`` with a Gaussian kernel K of `width`, standard normal g, coefficient c."""
    from scipy.spatial.distance import cdist  # the names of the tests are known without it

    kernel = np.exp(-cdist(points, points, "sqeuclidean") / (2 * width**2))
    return points + kernel @ rng.standard_normal(points.shape) * coefficient


def _one_to_one(source: np.ndarray, target: np.ndarray) -> Disturbed:
    rows = np.arange(len(source))
    return Disturbed(source, target, np.column_stack([rows, rows]))


def _count(ratio: float, prototype: np.ndarray) -> int:
    return round(ratio * len(prototype))


def _uniform(rng: np.random.Generator, count: int, centre: np.ndarray, side: Any) -> np.ndarray:
    return centre + (rng.random((count, len(centre))) - 0.5) * side


def _with_separate_outliers(clean: Disturbed, count: int, rng: np.random.Generator) -> Disturbed:
    centre = SEPARATE_CENTRE * np.eye(clean.source.shape[1])[0]
    return _with_outliers(
        clean,
        _uniform(rng, count, -centre, SEPARATE_SIDE),
        _uniform(rng, count, centre, SEPARATE_SIDE),
    )


def _with_outliers(clean: Disturbed, to_source: np.ndarray, to_target: np.ndarray) -> Disturbed:
    return Disturbed(
        np.vstack([clean.source, to_source]), np.vstack([clean.target, to_target]), clean.pairs
    )


# --- pose, shuffle, instance -------------------------------------------------------------------


def random_pose(dim: int, rng: np.random.Generator) -> np.ndarray:
    """Return a random pose: uniform angle and scale (2D) or rotation (3D), uniform shift per axis."""
    T = np.eye(dim + 1)
    if dim == 2:
        angle, scale = rng.uniform(0, 2 * np.pi), rng.uniform(*SCALE_RANGE_2D)
        cos, sin = np.cos(angle), np.sin(angle)
        T[:2, :2] = scale * np.array([[cos, -sin], [sin, cos]])
    else:
        from scipy.spatial.transform import Rotation

        T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:dim, dim] = rng.uniform(-MAX_SHIFT, MAX_SHIFT, dim)
    return T


def shuffle_target(
    target: np.ndarray, pairs: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The target in random order, and the pairs that follow it."""
    order = rng.permutation(len(target))
    place = np.argsort(order)
    return target[order], np.column_stack([pairs[:, 0], place[pairs[:, 1]]])


def seed_for(*axes: str | float | None) -> int:
    """A 64-bit seed from names and numbers; the same on every machine and in every version."""
    plain = [float(axis) if isinstance(axis, int | float | np.number) else axis for axis in axes]
    return int.from_bytes(hashlib.blake2b(json.dumps(plain).encode(), digest_size=8).digest())


def make_instance(
    dataset: Dataset,
    shape: str,
    test: str,
    level: float,
    trial: int,
    n_points: int | None = None,
    **options: Any,
) -> RawInstance:
    """The instance of these axes: generated from a prototype, or loaded from a record.

    Parameters
    ----------
    dataset : Dataset
    shape, test, level, trial
        `test` is a key of `DISTURBANCES` for prototypes, of ``dataset.tests()`` for records.
    n_points : int, optional
        Points of the prototype or scan.
    **options
        For the disturbance, e.g. ``two_sided=True``; records take none.
    """
    axes = (dataset.name, shape, test)
    rng_order = np.random.default_rng(seed_for("order", *axes, level, trial))
    if isinstance(dataset, RecordedDataset):
        if options:
            raise ValueError(f"dataset {dataset.name} is recorded; it takes no {sorted(options)}")
        raw = dataset.instance(shape, test, level, trial, n_points)
        target, pairs = shuffle_target(raw.target, raw.pairs, rng_order)
        return replace(raw, target=target, pairs=pairs)

    assert isinstance(dataset, PrototypeDataset)
    prototype = dataset.prototype(shape, n_points)
    rng = np.random.default_rng(seed_for("disturbance", *axes, level, trial))
    rng_pose = np.random.default_rng(seed_for("pose", *axes, trial))
    clean = _disturbance(test)(prototype, level, rng, **options)
    moved = apply_pose(random_pose(prototype.shape[1], rng_pose), clean.target)
    target, pairs = shuffle_target(moved, clean.pairs, rng_order)
    scale_range = SCALE_RANGE_2D if prototype.shape[1] == 2 else (1.0, 1.0)
    T_true = reference_pose(clean.source, target, pairs, scale_range)
    return RawInstance(clean.source, target, pairs, T_true, scale_range)


def _disturbance(test: str) -> Disturbance:
    if test not in DISTURBANCES:
        raise ValueError(f"no disturbance {test!r}{suggestion(test, DISTURBANCES)}")
    return DISTURBANCES[test]
