"""Lists of feasible pairs, and certificates."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import dcreg
from dcreg.certificate import write
from tests.bad_input.case import A2, B2, Case, npz, register, sweep

PAIRS = {
    "fraction": (b"0.5 1\n", "not a table of pairs", "give two columns of row numbers"),
    "three columns": (b"0 1 2\n", "not a table of pairs", "give two columns of row numbers"),
    "one column": (b"0.5\n1\n", "1 column", "keep 2 or 3 columns"),
    "negative source": (b"-1 0\n", "-1 is not a source row", "use rows from 0 to 7"),
    "negative target": (b"0 -1\n", "-1 is not a target row", "use row numbers, from 0"),
    "source beyond": (b"8 0\n", "8 is not a source row", "use rows from 0 to 7"),
    "target beyond": (b"0 8\n", "8 for source point 0", "use integers from 0 to 7"),
    "huge source": (b"1e30 0\n", "1e+30 is not a source row", "use rows from 0 to 7"),
    "huge target": (b"0 1e30\n", "1e+30 is not a target row", "use row numbers, from 0"),
    "largest integer": (b"0 9223372036854775808\n", "9.22337e+18 is not a target row", "use row"),
    "nan": (b"0 nan\n", "not a table of pairs", "give two columns of row numbers"),
    "words": (b"0 1\na b\n", "line 2: 'a'", "correct or remove that line"),
    "too few": (b"0 0\n", "at most 1 pairs can be matched", "allow more pairs"),
    "one target for all": (b"0 0\n1 0\n2 0\n3 0\n4 0\n5 0\n", "at most 1 pairs", "allow more pairs"),
    "empty": (b"", "is empty", "give one point or pair per line"),
}  # fmt: skip


@functools.cache
def certificate() -> dcreg.Certificate:
    """A true certificate for the clouds of every case."""
    found = dcreg.register(
        A2,
        B2,
        n_inliers=6,
        model="similarity2d",
        tol=0.1,
        options=dcreg.SolveOptions(certificate=True),
    )
    assert found.certificate is not None
    return found.certificate


def _sealed(**changes: object) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.npz"
        write(path, replace(certificate(), **changes))
        return path.read_bytes()


def _certificates() -> Iterator[Case]:
    clouds = ["a2.txt", "b2.txt"]
    verify = ["verify", "c.npz", *clouds]
    remedy = "`dcreg register --certificate` writes a certificate"
    yield Case("certificates", "missing", verify, ["c.npz", "no such file", remedy])
    no_arrays = npz(x=np.zeros(3))
    for name, content, words in (
        ("folder", None, "is a folder"),
        ("text", b"1 2\n3 4\n", "not an .npz file"),
        ("nothing", b"", "not an .npz file"),
        ("JSON", b'{"status": "optimal"}', "not an .npz file"),
        ("picture", b"\x89PNG\r\n\x1a\n" + bytes(50), "not an .npz file"),
        ("pickle", b"\x80\x04\x95\x00", "not an .npz file"),
        ("other arrays", no_arrays, "not a dcreg leaf cover"),
        ("no arrays", npz(), "not a dcreg leaf cover"),
        ("another version", npz(format="dcreg leaf cover", format_version=9), "format version"),
    ):
        case = ["c.npz", words, remedy]
        yield Case("certificates", name, verify, case, {"c.npz": content})
    good = _sealed()
    again = "make a new certificate with"
    for name, content, words in (
        ("cut off", good[:-100], "not a readable certificate"),
        ("half", good[: len(good) // 2], "not a readable certificate"),
        ("first bytes", good[:4], "not a readable certificate"),
    ):
        case = ["c.npz", words, again]
        yield Case("certificates", name, verify, case, {"c.npz": content}, code=5)
    c = certificate()
    for name, changes, words in (
        ("false lower bound", {"lower_bound": 2 * c.upper_bound}, "lower_bound"),
        ("negative lower bound", {"lower_bound": -1.0}, "lower_bound -0.13"),
        ("false upper bound", {"upper_bound": 0.9 * c.upper_bound}, "upper_bound"),
        ("nan", {"upper_bound": np.nan}, "upper_bound: not a finite number"),
        ("false leaf bounds", {"leaf_bounds": c.leaf_bounds + 9.0}, "bound is false"),
        (
            "leaves passed off as inadmissible",
            {"leaf_reasons": 1 + 0 * c.leaf_reasons, "leaf_bounds": np.inf + c.leaf_bounds},
            "bound is false",
        ),
        ("a leaf less", {"leaf_lower": c.leaf_lower[1:]}, "leaf_lower: shape"),
        ("a gap", {"leaf_upper": 0.9 * c.leaf_upper + 0.1 * c.leaf_lower}, "leaves: a gap"),
        ("small start box", {"start_upper": 0.5 * c.start_upper}, "start box: axis"),
        ("more pairs", {"n_inliers": 7}, "7"),
        ("no pairs", {"n_inliers": 0}, "n_inliers: out of range"),
        ("pairs beyond the clouds", {"n_inliers": 99}, "n_inliers: 99 exceeds"),
        ("another model", {"model": "affine"}, "model 'affine' is unknown"),
        ("model of space", {"model": "translation3d"}, "shape"),
        ("unit of zero", {"unit": 0.0}, "out of range"),
        ("negative tolerance", {"gap_tol": -1.0}, "out of range"),
        ("inadmissible pose", {"theta": 9.0 * np.ones(4)}, "theta: not an admissible"),
        ("scale range", {"scale_range": [2.0, 1.0]}, "0 < low <= high is needed"),
        ("unknown reasons", {"leaf_reasons": c.leaf_reasons + 7}, "unknown reason"),
        ("negative candidates", {"candidates": [[-1, 0]]}, "candidates: a negative index"),
        ("candidates beyond", {"candidates": [[99, 0]]}, "candidates: an index exceeds"),
        ("another source", {"source_digest": "0"}, "source: differs from"),
    ):
        case = [words, again]
        files = {"c.npz": _sealed(**changes)}
        yield Case("certificates", f"forged: {name}", verify, case, files, code=5)
    for name, run, words in (
        ("clouds exchanged", ["b2.txt", "a2.txt"], ["source: differs from", again]),
        ("clouds in 3D", ["a3.txt", "b3.txt"], ["source: differs from", again]),
    ):
        yield Case("certificates", name, ["verify", "c.npz", *run], words, {"c.npz": good}, code=5)
    yield Case("certificates", "no source", ["verify", "c.npz", "x.txt", "b2.txt"],
               ["x.txt: no such file", "check the path"], {"c.npz": good})  # fmt: skip


def _candidates() -> Iterator[Case]:
    for name, (content, *words) in PAIRS.items():
        call = sweep if len(name) % 2 else register
        # the message names the file or, where it is the list that does not do, the option
        yield Case("candidates", name, call("--candidates", "p.txt"), words, {"p.txt": content})
    absent = register("--candidates", "p.txt")
    yield Case("candidates", "missing", absent, ["p.txt", "no such file", "check the path"])


CANDIDATES, CERTIFICATES = list(_candidates()), list(_certificates())
