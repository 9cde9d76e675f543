"""Point clouds moved by a pose and written to a file.

If the new file is of the same format as the old one, it is an edited copy. Otherwise only the points are
written.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dcreg.files import whole_file
from dcreg.io.arrays import npz_cloud
from dcreg.io.edit import EDITORS, array_file, edit_npz
from dcreg.io.move import Move
from dcreg.io.points import READERS, read_points, split_key
from dcreg.io.text import naming
from dcreg.names import CLOUD_SUFFIXES
from dcreg.problem import InputError


def write_moved(
    source: str | Path,
    T_target_source: np.ndarray,
    path: str | Path,
    *,
    key: str | None = None,
) -> None:
    """Write the points of a file, moved by a pose.

    If both files are of the same format, or both are text, everything else is copied: colours and other
    properties, further columns, faces, other arrays, comments. Otherwise only the points are written.
    Points with NaN or infinity stay as they are. Normals called ``nx ny nz`` or ``normal_x normal_y
    normal_z`` are rotated; columns without names are copied. Compressed PCD files become binary ones.
    Coordinates keep their type, but integers, and 4-byte numbers that would round by more than a
    millionth of the extent of the cloud, become 8-byte numbers.

    Parameters
    ----------
    source : str or Path
        A file that `dcreg.read_points` reads; it is not changed unless `path` names it.
    T_target_source : (d+1, d+1) array
        Pose as a homogeneous matrix, such as `Result.T_target_source`.
    path : str or Path
        A ``.ply .pcd .xyz .txt .csv .npy .npz`` file. It is written completely or not at all.
    key : str, optional
        Name of the array in an ``.npz`` or ``.mat`` source, or number of the scan in an ``.e57`` source.

    Raises
    ------
    InputError
        If the source cannot be read, the pose does not have its dimension, or the suffix is unknown.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in CLOUD_SUFFIXES:
        raise InputError(f"path: {path} must end in {' or '.join(CLOUD_SUFFIXES)}")
    points = read_points(source, key=key, keep_invalid=True)
    T, size = np.asarray(T_target_source, dtype=np.float64), points.shape[1] + 1
    if T.shape != (size, size) or not np.isfinite(T).all():
        raise InputError(
            f"T_target_source: shape {T.shape} for points with {size - 1} coordinates; give a finite "
            f"homogeneous matrix of shape ({size}, {size})"
        )
    content = _edited(source, key, suffix, Move(T, points))
    with whole_file(path) as part:
        part.write_bytes(content)


def _edited(source: str | Path, key: str | None, suffix: str, move: Move) -> bytes:
    """Return the content of the new file: an edited copy where the formats allow it."""
    file, key = split_key(source, key)
    old = file.suffix.lower()
    if old != suffix and not {old, suffix} <= TEXT:
        return PLAIN[suffix](move)
    with naming(file):
        if old == ".npz":
            with file.open("rb") as stream:
                name, array = npz_cloud(stream, key)
            return edit_npz(file.read_bytes(), name, array.dtype, move)
        content = EDITORS[old](file.read_bytes(), move)
    is_kept = old == suffix or _is_accepted(content, suffix)
    return content if is_kept else PLAIN[suffix](move)


def _is_accepted(content: bytes, suffix: str) -> bool:
    """Whether a text file of this suffix may have these columns."""
    try:
        READERS[suffix](io.BytesIO(content), None)
    except InputError:
        return False
    return True


# --- points alone -------------------------------------------------------------------------------------


def _plain_text(move: Move) -> bytes:
    return "".join(f"{' '.join(map(repr, row))}\n" for row in move.moved.tolist()).encode()


def _plain_csv(move: Move) -> bytes:
    rows = ["xyz"[: move.points.shape[1]], *(map(repr, row) for row in move.moved.tolist())]
    return "".join(f"{','.join(row)}\n" for row in rows).encode()


def _plain_ply(move: Move) -> bytes:
    n, d = move.points.shape
    axes = "".join(f"property double {axis}\n" for axis in "xyz"[:d])
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{axes}end_header\n"
    return head.encode() + move.moved.astype("<f8").tobytes()


def _plain_pcd(move: Move) -> bytes:
    """Return numbers of 4 bytes, as the Point Cloud Library expects, unless they round too much."""
    n, d = move.points.shape
    size = 8 if move.is_wide else 4
    head = (
        f"VERSION 0.7\nFIELDS {' '.join('xyz'[:d])}\nSIZE{f' {size}' * d}\nTYPE{' F' * d}\n"
        f"COUNT{' 1' * d}\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    with np.errstate(all="ignore"):
        return head.encode() + move.moved.astype(f"<f{size}").tobytes()


def _plain_npz(move: Move) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, points=move.moved)
    return stream.getvalue()


def _plain_npy(move: Move) -> bytes:
    return array_file(np.dtype(np.float64), move)


TEXT = {".txt", ".csv", ".xyz"}
# Functions that return a file with the points alone.
PLAIN: dict[str, Callable[[Move], bytes]] = {
    ".ply": _plain_ply,
    ".pcd": _plain_pcd,
    ".xyz": _plain_text,
    ".txt": _plain_text,
    ".csv": _plain_csv,
    ".npy": _plain_npy,
    ".npz": _plain_npz,
}
