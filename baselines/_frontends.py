"""What turns two point sets into putative pairs. A front end is part of a method's identity.

``fpfh-mutual``
    Open3D's FPFH features; pairs of points that are each other's nearest in feature space. Radii
    are multiples of the target's median point spacing, the same for both sets.
``all-pairs``
    Every source point with every target point; refused beyond a stated number of pairs.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from baselines import _open3d
from baselines._poses import median_spacing
from baselines.contract import Baseline, Card, Instance, Limits, Solution
from dcreg.result import Status

FRONT_ENDS = ("fpfh-mutual", "all-pairs")
OPEN3D = "pip install open3d; on a bare Debian also apt-get install libusb-1.0-0 libgl1 libegl1"


class FrontEndError(Exception):
    """A front end cannot give pairs for this instance; the message says why."""


def unavailable(front_end: str) -> str | None:
    """None when the front end can run here, otherwise the reason with how to get it."""
    if front_end != "fpfh-mutual":
        return None
    try:
        import open3d  # noqa: F401
    except Exception as error:  # a missing system library is an OSError or ImportError
        return f"front end fpfh-mutual needs open3d: {error}. {OPEN3D}"
    return None


def putative_pairs(instance: Instance, options: dict[str, Any]) -> np.ndarray:
    """Rows (source index, target index) from the front end and settings named in `options`."""
    if options["front_end"] == "all-pairs":
        return all_pairs(instance, options["max_pairs"])
    return fpfh_mutual(instance, options["normal_radius"], options["feature_radius"])


def fpfh_mutual(instance: Instance, normal_radius: float, feature_radius: float) -> np.ndarray:
    """Mutual nearest FPFH matches; radii in median spacings of the target."""
    spacing = median_spacing(instance.target)
    source = _fpfh(instance.source, normal_radius * spacing, feature_radius * spacing)
    target = _fpfh(instance.target, normal_radius * spacing, feature_radius * spacing)
    to_target = cKDTree(target).query(source)[1]
    to_source = cKDTree(source).query(target)[1]
    rows = np.arange(len(source))
    mutual = to_source[to_target] == rows
    return np.column_stack([rows[mutual], to_target[mutual]])


def all_pairs(instance: Instance, max_pairs: int) -> np.ndarray:
    """The complete bipartite list of pairs."""
    n, m = len(instance.source), len(instance.target)
    if n * m > max_pairs:
        raise FrontEndError(f"all-pairs gives {n * m} pairs, more than max_pairs = {max_pairs}")
    return np.column_stack([np.repeat(np.arange(n), m), np.tile(np.arange(m), n)])


def _fpfh(points: np.ndarray, normal_radius: float, feature_radius: float) -> np.ndarray:
    """FPFH of every point, (n, 33)."""
    import open3d

    _open3d.quiet()
    search = open3d.geometry.KDTreeSearchParamHybrid
    cloud = _open3d.cloud(points)
    cloud.estimate_normals(search(radius=normal_radius, max_nn=30))
    features = open3d.pipelines.registration.compute_fpfh_feature(
        cloud, search(radius=feature_radius, max_nn=100)
    )
    return np.asarray(features.data).T


class CorrespondenceMethod(Baseline):
    """A rigid 3D method that treats putative pairs from a front end."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        if self.options["front_end"] not in FRONT_ENDS:
            raise ValueError(
                f"option front_end = {self.options['front_end']!r}; "
                f"choose one of {', '.join(FRONT_ENDS)}"
            )

    def available(self) -> str | None:
        return super().available() or unavailable(self.options["front_end"])

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        deadline = time.perf_counter() + limits.time_s
        try:
            pairs = putative_pairs(instance, self.options)
        except FrontEndError as error:
            return Solution(Status.FAILED, None, str(error))
        counters = {"n_correspondences": len(pairs)}
        if len(pairs) < instance.dim:
            message = f"{len(pairs)} correspondences, a pose needs {instance.dim}"
            return Solution(Status.FAILED, None, message, counters=counters)
        pose = self.solve_pairs(instance, pairs, limits)
        if pose is None:
            message = "the method found no consistent correspondences"
            return Solution(Status.FAILED, None, message, counters=counters)
        if time.perf_counter() > deadline:  # a library call cannot be interrupted
            message = "the solver ended after the time limit"
            return Solution(Status.TIME_LIMIT, pose, message, counters=counters)
        return Solution(Status.CONVERGED, pose, counters=counters)

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, limits: Limits
    ) -> np.ndarray | None:
        """The rigid pose from these pairs, None when there is none."""
        raise NotImplementedError(f"{type(self).__name__} must define solve_pairs")
