"""Reader of a pose in the formats of other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dcreg.io.text import naming
from dcreg.problem import InputError, checked_pose

_FORMATS = (
    "give a matrix (4 x 4 or 3 x 3, as text or .npy), JSON of dcreg, one line of KITTI (12 numbers), or "
    "one line of TUM (time, translation, quaternion x y z w)"
)
_SIZES = 8, 9, 12, 16  # numbers of a pose: TUM, 3 x 3, KITTI, 4 x 4


def read_pose(path: str | Path) -> np.ndarray:
    """Return the pose of a file, from source to target.

    Parameters
    ----------
    path : str or Path
        A matrix as text or ``.npy``, the JSON of a result of dcreg, or one pose in the format of KITTI
        (12 numbers, the rows of a 3 x 4 matrix) or TUM (8 numbers: time, translation, quaternion x y z
        w).

    Returns
    -------
    (d+1, d+1) array

    Raises
    ------
    InputError
        If the file cannot be read, or holds no pose.
    """
    path = Path(path)
    with naming(path):
        if not path.is_file():
            raise InputError("no such file; check the path")
        values = _values(path)
        size = {9: 3, 16: 4}.get(values.size)
        if size is not None:
            T = values.reshape(size, size)
        elif values.size == 12:
            T = np.vstack([values.reshape(3, 4), np.eye(4)[3]])
        elif values.size == 8:
            T = _of_quaternion(values[1:4], values[4:])
        else:
            raise InputError(
                f"{values.size} numbers are not a pose, which has 8, 9, 12 or 16; {_FORMATS}"
            )
        return checked_pose("pose", T, len(T) - 1, has_scale=True)


def _values(path: Path) -> np.ndarray:
    if path.suffix.lower() == ".npy":
        try:
            return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64).ravel()
        except (ValueError, TypeError, OSError, EOFError) as error:
            raise InputError(f"not an array of numbers ({error}); {_FORMATS}") from None
    try:
        content = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as text ({error}); {_FORMATS}") from None
    if content.lstrip().startswith("{"):
        return _of_json(content)
    lines = [line.split("#")[0].replace(",", " ").split() for line in content.splitlines()]
    rows = [fields for fields in lines if fields]
    widths = {len(fields) for fields in rows}
    if len(rows) > 1 and len(widths) == 1 and not widths.isdisjoint(_SIZES):
        raise InputError(
            f"{len(rows)} poses, one per line, such as a trajectory; give a file with one line, "
            "the pose from source to target"
        )
    try:
        return np.array([float(field) for fields in rows for field in fields])
    except ValueError as error:
        raise InputError(f"{error}; {_FORMATS}") from None


def _of_json(content: str) -> np.ndarray:
    try:
        values: Any = json.loads(content)["T_target_source"]
        return np.array(values, dtype=np.float64).ravel()
    except (KeyError, TypeError, ValueError, RecursionError):
        raise InputError(
            "JSON without a matrix 'T_target_source'; give the file of `dcreg register --json`"
        ) from None


def _of_quaternion(shift: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return the pose of a translation and a quaternion (x, y, z, w)."""
    from scipy.spatial.transform import Rotation

    if abs(np.linalg.norm(quaternion) - 1.0) > 1e-2:
        raise InputError(
            f"the quaternion {quaternion.tolist()} has the length {np.linalg.norm(quaternion):.4g}, "
            "not 1; the order is time, translation, x, y, z, w"
        )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), shift
    return T
