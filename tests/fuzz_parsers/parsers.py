"""The parsers, each with valid files, changes of them, and the errors that it may raise."""

from __future__ import annotations

import functools
import gzip
import io
import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np
import pandas as pd
import yaml
from scipy.io import savemat

import dcreg
from baselines import registry as methods
from data import registry as datasets
from data.contract import DataError
from dcreg.certificate import format as certificates
from dcreg.certificate.verification import verify
from dcreg.io import read_matches, read_points
from dcreg.io.moved import write_moved
from dcreg.names import CLOUD_SUFFIXES
from dcreg.problem import InputError
from reports.archive import read as archives
from reports.archive import write as archiving
from reports.tables import Tables
from tests.bad_input.case import A2, A3, B2, B3
from tests.bad_input.configs import GOOD
from tests.fuzz_parsers import mutate
from tests.unit.report_fixture import write_tables
from tests.unit.test_io import pcd, ply
from workflows import CHECKOUT, UserError, config
from workflows.archives import CHECKSUMS
from workflows.integrity import digest


@dataclass(frozen=True)
class Parser:
    """A parser and its bad files.

    Attributes
    ----------
    name : str
    make : callable
        Writes a changed file or folder into an empty folder and returns its path.
    read : callable
        Reads it as a user would.
    refusals : tuple of exception types
        What `read` may raise.
    few : int
        Files of the short version, which takes a few seconds.
    """

    name: str
    make: Callable[[Random, Path], Path]
    read: Callable[[Path], object]
    refusals: tuple[type[Exception], ...]
    few: int


# --- YAML: configs and cards ---------------------------------------------------------------------


def _yaml(rng: Random, content: str) -> bytes:
    match rng.randrange(20):
        case 0 | 1:
            return mutate.in_bytes(rng, content.encode())
        case 2 | 3 | 4 | 5 | 6 | 7:
            return mutate.in_words(rng, content.encode(), (*mutate.YAML_WORDS, *mutate.TEXTS))
    tree = mutate.in_tree(rng, yaml.safe_load(content))
    return yaml.safe_dump(tree, allow_unicode=True, sort_keys=False).encode("utf-8", "replace")


@functools.cache
def _texts(pattern: str) -> dict[str, str]:
    """Return the content of small files of the checkout by the name of file and folder."""
    paths = sorted(CHECKOUT.glob(pattern))
    texts = {f"{path.parent.name}/{path.stem}": path.read_text("utf-8") for path in paths}
    return {name: text for name, text in texts.items() if len(text) < 3000}


def make_config(rng: Random, folder: Path) -> Path:
    path = folder / "bad.yaml"
    texts = [*(GOOD,) * 20, *_texts("workflows/configs/*.yaml").values()]  # the last ones are slow
    # names of the checkout's configs are reserved
    path.write_bytes(_yaml(rng, re.sub(r"(?m)^name: .*", "name: own", rng.choice(texts))))
    return path


def make_card(pattern: str, rng: Random, folder: Path) -> Path:
    name, text = rng.choice(list(_texts(pattern).items()))
    path = folder / name.split("/")[0] / "card.yaml"
    path.parent.mkdir()
    path.write_bytes(_yaml(rng, text))
    return path


def read_dataset_card(path: Path) -> None:
    datasets._build(datasets.read_card(path))


def read_method_card(path: Path) -> None:
    methods.read_card(path.parent.name, path.parents[1])


# --- point files ---------------------------------------------------------------------------------


def _rows(points: np.ndarray, separator: str, header: str = "") -> bytes:
    stream = io.StringIO()
    np.savetxt(stream, points, delimiter=separator, header=header, comments="")
    return stream.getvalue().encode()


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, array in arrays.items():
            packed.writestr(f"{name}.npy", _npy(array))
    return stream.getvalue()


def _mat(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    savemat(stream, {f"a{index}": array for index, array in enumerate(arrays.values())})
    return stream.getvalue()


ORDERS = ("ascii", "binary_little_endian", "binary_big_endian")
POINT_FILES: list[tuple[str, bytes]] = [
    *((".txt", content) for content in (_rows(A2, " "), b"8\n" + _rows(A3, "\t"), _rows(A2, ";"))),
    (".csv", _rows(A3, ",", "name,x,y,z".replace("name,", ""))),
    (".csv", _rows(np.hstack([A2, A2]), ",", "u,x,v,y")),
    (".xyz", _rows(np.hstack([A3, A3]), " ")),
    *((".ply", ply(order, first)) for order in ORDERS for first in (False, True)),
    *((".pcd", pcd(kind)) for kind in ("ascii", "binary", "binary_compressed")),
    (".off", b"OFF\n8 1 0\n" + _rows(A3, " ") + b"3 0 1 2\n"),
    (".npy", _npy(A2)), (".npy", _npy(np.asfortranarray(A3.astype(">f4")))),
    (".npz", _npz({"a": A2})), (".npz", _npz({"a": A3, "b": np.arange(4)})),
    (".mat", _mat({"a": A2})), (".mat", _mat({"a": A3, "b": np.arange(4)})),
]  # fmt: skip
WRITERS = {".npz": _npz, ".mat": _mat, ".npy": lambda arrays: _npy(next(iter(arrays.values())))}


def make_points(rng: Random, folder: Path) -> Path:
    suffix, content = rng.choice(POINT_FILES)
    path = folder / f"cloud{suffix}"
    if suffix in WRITERS and rng.random() < 0.5:
        arrays = mutate.in_arrays(rng, {"a": rng.choice((A2, A3)), "b": np.arange(4.0)})
        try:
            path.write_bytes(WRITERS[suffix](arrays or {"a": A2}))
            return path
        except (ValueError, TypeError, NotImplementedError):  # the format has no such arrays
            pass
    change = rng.choice((mutate.in_bytes, mutate.in_words, mutate.in_words))
    path.write_bytes(change(rng, content))
    return path


def read_cloud(path: Path) -> None:
    try:
        points = read_points(path)
        assert points.ndim == 2
        assert points.shape[1] in (2, 3)
        assert np.isfinite(points).all()
    finally:
        if path.suffix in (".npz", ".mat"):
            read_points(f"{path}:a")
        else:
            read_matches(path, 8, 8)


def move_cloud(path: Path) -> None:
    """Move what can be read, and compare the file that is written."""
    points = read_points(path, keep_invalid=True)
    d, valid = points.shape[1], np.isfinite(points).all(axis=1)
    pose = np.eye(d + 1)
    pose[:2, :2], pose[:d, d] = [[0.0, -1.0], [1.0, 0.0]], np.arange(d)
    expected = points.copy()
    with np.errstate(all="ignore"):
        expected[valid] = points[valid] @ pose[:d, :d].T + pose[:d, d]
    extent = np.ptp(expected[valid], axis=0).max() if valid.any() else 0.0
    for suffix in {path.suffix, ".pcd"}.intersection(CLOUD_SUFFIXES):
        file = path.with_name(f"moved{suffix}")
        write_moved(path, pose, file)
        found = read_points(file, keep_invalid=True)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * extent + 1e-30)


# --- certificates --------------------------------------------------------------------------------


@functools.cache
def _certificates() -> dict[str, dict[str, np.ndarray]]:
    """Return the arrays of a certificate in 2D and of one in 3D."""
    found = {}
    for name, source, target, settings in (
        ("2d", A2[:4], B2[:4], {"model": "similarity2d"}),
        ("3d", A3[:4], B3[:4], {"model": "rigid3d"}),
    ):
        mode = "paper" if name == "3d" else None
        options = dcreg.SolveOptions(certificate=True, **({"mode": mode} if mode else {}))
        result = dcreg.register(source, target, n_inliers=3, tol=0.5, options=options, **settings)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "c.npz")
            assert result.certificate is not None
            certificates.write(path, result.certificate)
            with np.load(path) as arrays:
                found[name] = dict(arrays)
    return found


def make_certificate(rng: Random, folder: Path) -> Path:
    name, arrays = rng.choice(list(_certificates().items()))
    path = folder / f"{name}.npz"
    if rng.random() < 0.3:
        path.write_bytes(mutate.in_bytes(rng, _npz(arrays)))
        return path
    own = [entry for entry in arrays if entry != "checksum"]
    changed = mutate.in_arrays(rng, {entry: arrays[entry] for entry in own})
    if rng.random() < 0.8:
        changed["checksum"] = np.array(certificates._checksum(changed))
    path.write_bytes(_npz(changed))
    return path


def read_certificate(path: Path) -> None:
    source, target = (A2, B2) if path.stem == "2d" else (A3, B3)
    report = verify(path, source[:4], target[:4], n_samples=20, max_boxes=100)
    assert report.accepted or report.reason
    certificates.read(path)


# --- archives ------------------------------------------------------------------------------------


@functools.cache
def _archive() -> tempfile.TemporaryDirectory[str]:
    """Return a folder with the valid archive ``archive``; it exists as long as the object does."""
    found = tempfile.TemporaryDirectory(prefix="dcreg-fuzz-")
    folder = Path(found.name)
    write_tables(folder / "results" / "one" / "tables", "one")
    archiving.write([folder / "results"], folder / "archive", "1.0")
    return found


def make_archive(rng: Random, folder: Path) -> Path:
    place = folder / "in"
    shutil.copytree(Path(_archive().name, "archive"), place)
    files = sorted(path for path in place.rglob("*") if path.is_file())
    path = rng.choice(files)
    _change_file(rng, path)
    if rng.random() < 0.85 and path.name != CHECKSUMS:
        kept = [each for each in files if each.name != CHECKSUMS and each.exists()]
        lines = [f"{digest(each)}  {each.relative_to(place).as_posix()}\n" for each in kept]
        (place / CHECKSUMS).write_text("".join(lines), encoding="utf-8")
    return _zipped(rng, place) if rng.random() < 0.25 else place


def _change_file(rng: Random, path: Path) -> None:
    kind = rng.randrange(10)
    if kind == 0:
        path.unlink()
    elif kind == 1:
        path.write_bytes(mutate.in_bytes(rng, path.read_bytes()))
    elif path.suffix == ".parquet":
        mutate.in_table(rng, pd.read_parquet(path)).to_parquet(path, index=False)
    elif path.suffix in (".json", ".gz"):
        pack, unpack = (gzip.compress, gzip.decompress) if path.suffix == ".gz" else (bytes, bytes)
        tree = mutate.in_tree(rng, json.loads(unpack(path.read_bytes())))
        path.write_bytes(pack(json.dumps(tree).encode()))
    else:
        path.write_bytes(mutate.in_words(rng, path.read_bytes()))


MEMBERS = ("../out", "/out", "..\\out", "1.0/../../out", "1.0", "1.0/link", "a" * 300)


def _zipped(rng: Random, place: Path) -> Path:
    stream = io.BytesIO()
    with zipfile.ZipFile(
        stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ) as packed:
        for file in sorted(place.rglob("*")):
            packed.write(file, f"1.0/{file.relative_to(place)}")
        if rng.random() < 0.4:
            member = zipfile.ZipInfo(rng.choice(MEMBERS))
            member.external_attr = rng.choice((0o120777, 0o100644, 0o040755, 0o010644)) << 16
            packed.writestr(member, "/etc/passwd")
    content = stream.getvalue()
    path = place.with_suffix(".zip")
    path.write_bytes(content if rng.random() < 0.3 else mutate.in_bytes(rng, content))
    shutil.rmtree(place)
    return path


def read_archive(path: Path) -> None:
    work = path.parent / "a" / "b"  # so that two steps up are still inside the folder of the case
    try:
        folder = archives.folder_of(str(path), work / "cache")
        for tables in archives.restore(folder, work / "out"):
            Tables.load(tables)
    finally:
        found = {each.name for each in path.parent.iterdir()} | {
            each.name for each in work.glob("*")
        }
        assert found <= {path.name, "a", "b", "cache", "out"}, f"written outside: {found}"


PARSERS = [
    Parser(
        "configs",
        make_config,
        lambda path: config.load(str(path)),
        (config.ConfigError,),
        30,
    ),
    Parser(
        "dataset-cards",
        functools.partial(make_card, "data/*/card.yaml"),
        read_dataset_card,
        (DataError,),
        150,
    ),
    Parser(
        "method-cards",
        functools.partial(make_card, "baselines/*/card.yaml"),
        read_method_card,
        (methods.BaselineError,),
        150,
    ),
    Parser("points", make_points, read_cloud, (InputError,), 500),
    Parser("moved-points", make_points, move_cloud, (InputError,), 150),
    Parser(
        "certificates", make_certificate, read_certificate, (certificates.CertificateError,), 200
    ),
    Parser("archives", make_archive, read_archive, (UserError,), 15),
]
