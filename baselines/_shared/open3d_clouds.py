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
