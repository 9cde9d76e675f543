"""Certificates on disk: the leaf boxes of a finished search, with everything needed to check them.

A certificate is an .npz file of plain arrays (never a pickle) with a checksum over all of them. It
states that the objective of one family of poses is at least `lower_bound` everywhere in the start box,
and equals `upper_bound` at `theta`. Its leaf boxes are a partition of the start box. Each has a lower
bound and the reason why it was not divided further. `dcreg.certificate.verify` checks all this without
the code of the search. Lengths are in normalised units, objectives in their squares.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from dcreg._version import __version__
from dcreg.files import whole_file

FORMAT = "dcreg leaf cover"
FORMAT_VERSION = 5
WITHOUT_DUALS = 4  # the version before had no duals
MODELS = {  # dimension of the points, and number of parameters
    "similarity2d": (2, 4),
    "translation3d": (3, 3),
    "rigid3d": (3, 7),
}
LARGEST = 1e150  # absolute value of an entry: its square is a number

# Why a leaf was not divided further.
PRUNED = 0  # its bound reached upper_bound - gap_tol
INADMISSIBLE = 1  # it contains no admissible parameter
OPEN = 2  # a limit ended the search first


_MAGIC = b"PK"  # an .npz is a zip file
# By entry or by annotation; all others are floats.
_DTYPES: dict[str, type] = {
    "candidates": np.int64, "leaf_reasons": np.int8, "leaf_duals": np.uint8, "dual_units": np.int8,
}  # fmt: skip
_DTYPES |= {"int": np.int64, "str": np.str_}


class CertificateError(ValueError):
    """A certificate that cannot be accepted; the message is the reason."""


class UnprovenError(CertificateError):
    """A lower bound that may hold, but that the permitted number of boxes does not prove."""


def require(holds: bool | np.bool_, problem: str) -> None:
    """Refuse a certificate unless a condition holds."""
    if not holds:
        raise CertificateError(problem)


class NothingToCheckError(CertificateError):
    """A request that no check can answer, rather than a false or damaged certificate."""


class NoCertificateError(NothingToCheckError):
    """A file that is not a certificate of this format, rather than a false or damaged one."""

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}; `dcreg register --certificate` writes a certificate")


@dataclass(frozen=True)
class Certificate:
    """Everything that a certificate states; `dcreg.verify` checks it, `dcreg.certificate.write` saves it.

    Attributes
    ----------
    source_digest, target_digest : str
        `digest` of the clouds as given to `dcreg.register`.
    model : {"similarity2d", "translation3d", "rigid3d"}
        2D similarity poses, translations in norm space about `target_centre`, or rigid 3D poses. The
        last ones are quaternions and translations that move the smaller cloud, the source if both have
        the same size.
    mode, bound, status : str
        How the leaves were found, for information only, except that ``status == "optimal"`` claims a
        closed gap, and a lower bound above 0 or an exact fit.
    n_inliers : int
    scale_range : (2,) array
    source_centre, target_centre : (dim,) arrays
    unit : float
        The frame: normalised points are ``(points - centre) / unit``.
    start_lower, start_upper : (d,) arrays
    leaf_lower, leaf_upper : (L, d) arrays
    leaf_bounds : (L,) array
        +inf only for inadmissible leaves. Rigid 3D poses: bounds on the optima in the leaf.
    leaf_reasons : (L,) int8 array
        PRUNED, INADMISSIBLE or OPEN.
    theta : (d,) array
    lower_bound, upper_bound, gap_tol : float
    candidates : (c, 2) int array
        The feasible pairs, source and target index; if empty, every pair is feasible.
    leaf_duals : (L, m) uint8 array
        Rigid 3D poses: dual variables of the points of the larger cloud, which the check of a leaf begins
        with. Any values are valid. Empty if there are none.
    dual_units : (L,) int8 array
        Their units are the powers of two with these exponents, in squared normalised units.
    dcreg_version : str
        Version of the library that wrote it.
    """

    source_digest: str
    target_digest: str
    model: str
    mode: str
    bound: str
    status: str
    n_inliers: int
    scale_range: np.ndarray
    source_centre: np.ndarray
    target_centre: np.ndarray
    unit: float
    start_lower: np.ndarray
    start_upper: np.ndarray
    leaf_lower: np.ndarray
    leaf_upper: np.ndarray
    leaf_bounds: np.ndarray
    leaf_reasons: np.ndarray
    theta: np.ndarray
    lower_bound: float
    upper_bound: float
    gap_tol: float
    candidates: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    leaf_duals: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    dual_units: np.ndarray = field(default_factory=lambda: np.empty(0))
    dcreg_version: str = field(default=__version__)

    def __post_init__(self) -> None:
        """Convert every field to its plain type, so that equal certificates give equal files."""
        for entry in fields(self):
            value: np.ndarray = np.array(getattr(self, entry.name), _type_of(entry), order="C")
            object.__setattr__(self, entry.name, value if value.ndim else value.item())


def digest(points: np.ndarray) -> str:
    """Return the SHA-256 of a cloud: its shape and its coordinates as little-endian doubles."""
    points = np.ascontiguousarray(points, dtype="<f8")
    return hashlib.sha256(repr(points.shape).encode() + points.tobytes()).hexdigest()


def write(path: str | Path, certificate: Certificate) -> None:
    """Write `certificate` to an .npz file, completely or not at all.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    arrays: dict[str, Any] = {
        entry.name: np.array(getattr(certificate, entry.name)) for entry in fields(certificate)
    }
    arrays |= {"format": np.array(FORMAT), "format_version": np.array(FORMAT_VERSION)}
    arrays["checksum"] = np.array(_checksum(arrays))
    # an open file keeps numpy from appending ".npz"
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read(path: str | Path) -> Certificate:
    """Read a complete certificate with the right checksum; its statement is not checked.

    Raises
    ------
    CertificateError
        If the file is unreadable, truncated, changed or of another version, with the reason;
        a `NoCertificateError` if the file is not a certificate.
    """
    path = Path(path)
    if path.is_dir():
        raise NoCertificateError(path, "is a folder")
    if not path.is_file():
        raise NoCertificateError(path, "no such file")
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise NoCertificateError(path, "not a readable certificate (not an .npz file)")
            file.seek(0)
            loaded = np.load(file, allow_pickle=False)
            arrays = dict(loaded) if isinstance(loaded, Mapping) else {}
    except NoCertificateError:
        raise
    except OSError as error:
        raise NoCertificateError(path, f"cannot be read ({error.strerror or error})") from None
    except Exception as error:  # whatever numpy, zipfile and zlib raise for damaged files
        raise CertificateError(f"{path}: not a readable certificate ({error})") from None
    stated = str(arrays.pop("checksum", ""))
    if str(arrays.get("format")) != FORMAT:
        raise NoCertificateError(path, f"not a {FORMAT}")
    names = {entry.name for entry in fields(Certificate)} | {"format", "format_version"}
    version = str(arrays.get("format_version"))
    if version not in (str(FORMAT_VERSION), str(WITHOUT_DUALS)):
        known = f"versions {WITHOUT_DUALS} and {FORMAT_VERSION}"
        problem = f"format version {version}, but this dcreg reads {known} only"
        raise NoCertificateError(path, problem)
    absent: dict[str, np.ndarray] = {}
    if version == str(WITHOUT_DUALS):
        absent = {"leaf_duals": np.empty((0, 0), np.uint8), "dual_units": np.empty(0, np.int8)}
    wrong = sorted((names - set(absent)) ^ set(arrays))
    require(not wrong, f"{path}: wrong entries: {wrong}")
    is_whole = stated == _checksum(arrays)
    require(is_whole, f"{path}: the checksum does not match the content: changed or corrupt")
    arrays |= absent
    del arrays["format"], arrays["format_version"]
    for entry in fields(Certificate):
        array, dtype = arrays[entry.name], np.dtype(_type_of(entry))
        is_text = dtype.kind == array.dtype.kind == "U" and array.ndim == 0
        is_right = is_text or array.dtype.newbyteorder("=") == dtype
        require(is_right, f"{path}: {entry.name}: type {array.dtype}, expected {dtype.name}")
    certificate = Certificate(**arrays)
    check_shapes(certificate)
    return certificate


def _type_of(entry: Field[Any]) -> type:
    return _DTYPES.get(entry.name) or _DTYPES.get(str(entry.type), np.float64)


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, types, shapes and bytes."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {array.dtype.str} {arrays[name].shape}\n".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()


def check_shapes(c: Certificate) -> None:
    """Check that sizes fit each other and numbers are finite, so that later checks can rely on it.

    Raises
    ------
    CertificateError
        Naming the entry.
    """
    is_known = c.model in MODELS
    require(is_known, f"model {c.model!r} is unknown; a certificate refers to one of {(*MODELS,)}")
    dim, d = MODELS[c.model]
    count, duals = len(np.atleast_1d(c.leaf_bounds)), np.atleast_2d(c.leaf_duals)
    shapes: tuple[tuple[tuple[int, ...], tuple[str, ...]], ...] = (
        ((2,), ("scale_range",)),
        ((dim,), ("source_centre", "target_centre")),
        ((d,), ("start_lower", "start_upper", "theta")),
        ((count, d), ("leaf_lower", "leaf_upper")),
        ((count,), ("leaf_reasons", "leaf_bounds")),
        ((), ("unit", "lower_bound", "upper_bound", "gap_tol", "n_inliers")),
        ((len(np.atleast_1d(c.candidates)), 2), ("candidates",)),
        (duals.shape[:2], ("leaf_duals",)),
        (duals.shape[:1], ("dual_units",)),
    )
    for shape, names in shapes:
        for name in names:
            value = getattr(c, name)
            found = np.shape(value)
            require(found == shape, f"{name}: shape {found}, expected {shape}")
            if name == "leaf_bounds":
                value = value[c.leaf_reasons != INADMISSIBLE]
            is_small = (np.abs(value) < LARGEST).all()
            require(is_small, f"{name}: not a finite number below {LARGEST:g}")
    require(count > 0, "no leaves")
    known = np.isin(c.leaf_reasons, (PRUNED, INADMISSIBLE, OPEN))
    require(known.all(), "leaf_reasons: unknown reason")
    require(not np.isnan(c.leaf_bounds).any(), "leaf_bounds: not a number")
    in_range = c.unit > 0 and c.gap_tol >= 0 and c.n_inliers >= 1
    require(in_range, "unit, gap_tol or n_inliers: out of range")
    require((c.candidates >= 0).all(), "candidates: a negative index")
    require(len(duals) in (0, count), f"leaf_duals: of {len(duals)} of {count} leaves")
    low, high = c.scale_range
    require(0 < low <= high, f"scale_range: {c.scale_range}, but 0 < low <= high is needed")
    is_fixed = c.model == "similarity2d" or low == high == 1.0
    require(is_fixed, f"scale_range: {c.scale_range}, but model {c.model!r} has the scale 1")
