"""Conversions to Open3D, imported only when a method that needs it runs."""

from __future__ import annotations

from typing import Any

import numpy as np


def cloud(points: np.ndarray) -> Any:
    """Return an Open3D point cloud with these points."""
    import open3d

    result = open3d.geometry.PointCloud()
    # the binding refuses read-only arrays
    result.points = open3d.utility.Vector3dVector(np.array(points, dtype=float))
    return result


def quiet() -> None:
    """Silence Open3D, which warns about ordinary outcomes such as no correspondences."""
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)


def downsampled(points: np.ndarray, voxel: float) -> tuple[Any, Any]:
    """Return cloud and FPFH features by Open3D's recipe for global registration.

    The cloud is on a grid of `voxel`, normals are within two voxels, features within five.
    """
    import open3d

    quiet()
    search = open3d.geometry.KDTreeSearchParamHybrid
    few = cloud(points).voxel_down_sample(voxel)
    few.estimate_normals(search(radius=2 * voxel, max_nn=30))
    # its stub declares the optional `indices` as required
    describe: Any = open3d.pipelines.registration.compute_fpfh_feature
    return few, describe(few, search(radius=5 * voxel, max_nn=100))
