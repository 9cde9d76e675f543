"""Files of every format: missing, damaged, of another kind, with impossible points."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from importlib.util import find_spec

import numpy as np

from dcreg.io import READERS
from tests.bad_input.case import A2, Case, npz, register

TEXT = {
    "nan": (b"1 2\n3 nan\n", "in 1 of 2 points, first in line 2", "--drop-invalid"),
    "infinity": (b"1 2\ninf 4\n", "in 1 of 2 points, first in line 2", "--drop-invalid"),
    "overflow": (b"1 2\n1e999 4\n", "in 1 of 2 points, first in line 2", "--drop-invalid"),
    "word": (b"1 2\n3 four\n", "line 2: 'four'", "correct or remove that line"),
    "two points in a number": (b"1 2\n3 1.2.3\n", "line 2: '1.2.3'", "correct or remove"),
    "hexadecimal": (b"1 2\n3 0x10\n", "line 2: '0x10'", "correct or remove that line"),
    "underscore": (b"1 2\n3 1_0\n", "line 2: '1_0'", "correct or remove that line"),
    "complex": (b"1 2\n3 1+2j\n", "line 2: '1+2j'", "correct or remove that line"),
    "date": (b"1 2\n3 2024-01-01\n", "line 2: '2024-01-01'", "correct or remove that line"),
    "one value less": (b"1 2\n3\n", "line 2 has 1 value, expected 2", "the same number of values"),
    "one value more": (b"1 2\n3 4 5\n", "line 2 has 3 values", "the same number of values"),
    "a column of words": (b"1\tx\n2\t3\n", "line 1: 'x'", "correct or remove that line"),
    "single column": (b"1.5\n2.5\n", "1 column", "keep 2 or 3 columns"),
    "empty field": (b"1,2,3\n4,,6\n", "line 2: ''", "correct or remove that line"),
    "announced more": (b"5\n1 2\n3 4\n", "announces 5 points, 2 follow", "correct that line"),
    "announced fewer": (b"1\n1 2\n3 4\n", "announces 1 points, 2 follow", "correct that line"),
    "header alone": (b"x y\n", "holds no points", "give one point or pair per line"),
    "comments alone": (b"# x\n% y\n", "is empty", "give one point or pair per line"),
    "blank lines": (b"\n \n\n", "is empty", "give one point or pair per line"),
    "decimal comma beside blanks": (b"1,5 2,5\n", "line 1: '5 2'", "write a point instead"),
    "quoted decimal comma": (b'"1,5","2,5"\n"3,5","4,5"\n', "line 2: '3,5'", "write a point instead"),
    "thousands": (b"1.000.000 2\n3 4\n", "line 1: '1.000.000'", "correct or remove"),
    "zero bytes": ("1 2\n3 4\n".encode("utf-16"), "zero bytes found", "save it as UTF-8 text"),
    "binary": (bytes(range(256)), "zero bytes found", "save it as UTF-8 text"),
    "another language": ("1 2\n３ 四\n".encode(), "line 2: '四'", "correct or remove that line"),
    "html": (b"<html><body>404</body></html>\n", "holds no points", "give one point or pair per line"),
    "json": (b"[[1, 2],\n[3, 4]]\n", "line 2: '[3'", "correct or remove"),
}  # fmt: skip
NARROW = {  # what .xyz, with any number of columns, reads
    "four columns": (b"1 2 3 4\n5 6 7 8\n", "4 columns", "keep 2 or 3 columns"),
    "decimal comma between commas": (b"1,5,2,5\n1,5,2,5\n", "4 columns", "decimals need a point"),
}

PLY = b"""ply
format ascii 1.0
element vertex 3
property double x
property double y
property double z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
PLY_CHANGES = {
    "no magic": (b"ply\n", b"obj\n", "no complete .ply header", "export the file again"),
    "no end of header": (b"end_header\n", b"", "no complete .ply header", "export the file"),
    "no format": (b"format ascii 1.0\n", b"", "states no format", "export the file again"),
    "unknown format": (b"ascii 1.0", b"ascii 3.0", "line 2 is not valid PLY", "export the file"),
    "no vertices": (b"vertex 3", b"point 3", "no element 'vertex'", "export the file with its"),
    "no y": (b"double y", b"double v", "no x and y (properties: x, v, z)", "export the file"),
    "unknown type": (b"double x", b"half x", "'property half x'", "export the file again"),
    "vertices of lists": (b"double x", b"list uchar int x", "list properties", "export the points"),
    "negative count": (b"vertex 3", b"vertex -3", "'element vertex -3'", "export the file again"),
    "count is no number": (b"vertex 3", b"vertex x", "'element vertex x'", "export the file again"),
    "fewer than announced": (b"vertex 3", b"vertex 30", "announces 30 points, the file holds 4",
                             "copy or export the file again"),
    "more than announced": (b"vertex 3", b"vertex 2", "announces 2 points, the file holds 3",
                            "correct the header"),
    "huge count": (b"vertex 3", b"vertex 99999999999999", "announces 99999999999999 points",
                   "copy or export the file again"),
    "no points": (b"vertex 3", b"vertex 0", "announces 0 points, the file holds 3", "correct the"),
    "word": (b"1 0 0", b"1 x 0", "line 11: 'x' is not a number", "correct or remove"),
    "nan": (b"1 0 0", b"1 nan 0", "in 1 of 3 points, first in line 11", "--drop-invalid"),
    "short row": (b"1 0 0", b"1 0", "line 11 has 2 values, expected 3", "the same number"),
    "property before elements": (b"element vertex 3\n", b"", "'property double x'", "export the"),
}  # fmt: skip

PCD = b"""# .PCD v.7
VERSION .7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA ascii
0 0 0
1 0 0
0 1 0
"""
PCD_CHANGES = {
    "no data line": (b"DATA ascii\n", b"", "no complete .pcd header", "export the file again"),
    "unknown data": (b"DATA ascii", b"DATA text", "unknown DATA kind 'text'", "use ascii, binary"),
    "no fields": (b"FIELDS x y z\n", b"", "do not fit together", "export the file again"),
    "no y": (b"x y z", b"x u v", "no x and y (properties: x, u, v)", "export the file again"),
    "short sizes": (b"SIZE 4 4 4", b"SIZE 4 4", "do not fit together", "export the file again"),
    "size of three": (b"SIZE 4 4 4", b"SIZE 3 4 4", "do not fit together", "export the file again"),
    "unknown type": (b"TYPE F F F", b"TYPE C F F", "do not fit together", "export the file again"),
    "several values": (b"COUNT 1 1 1", b"COUNT 2 1 1", "several values per point", "export the"),
    "negative points": (b"POINTS 3", b"POINTS -3", "no valid number of points", "export the file"),
    "points are no number": (b"POINTS 3", b"POINTS x", "no valid number of points", "export the"),
    "width is no number": (b"WIDTH 3", b"WIDTH x", "no valid number of points", "export the file"),
    "points differ": (b"POINTS 3", b"POINTS 4", "POINTS 4, but WIDTH x HEIGHT = 3 x 1", "correct"),
    "width differs": (b"WIDTH 3", b"WIDTH 2", "POINTS 3, but WIDTH x HEIGHT = 2 x 1", "correct"),
    "height differs": (b"HEIGHT 1", b"HEIGHT 2", "WIDTH x HEIGHT = 3 x 2", "correct the header"),
    "fewer than announced": (b"0 1 0\n", b"", "announces 3 points, the file holds 2", "copy or"),
    "more than announced": (b"0 1 0\n", b"0 1 0\n0 0 1\n", "announces 3 points, the file holds 4",
                            "correct the header"),
    "no points": (PCD[PCD.index(b"WIDTH"):],
                  b"WIDTH 0\nHEIGHT 1\nPOINTS 0\nDATA ascii\n", "holds no points", "give a file"),
    "word": (b"1 0 0\n", b"1 x 0\n", "'x' is not a number", "correct or remove"),
    "short row": (b"1 0 0\n", b"1 0\n", "has 2 values, expected 3", "the same number"),
    "binary cut off": (b"DATA ascii\n0 0 0\n1 0 0\n0 1 0\n", b"DATA binary\n" + bytes(24),
                       "announces 3 points, the file holds 2", "copy or export"),
    "binary too long": (b"DATA ascii\n0 0 0\n1 0 0\n0 1 0\n", b"DATA binary\n" + bytes(48),
                        "announces 3 points, the file holds 4", "correct the header"),
    "compressed cut off": (b"DATA ascii\n0 0 0\n1 0 0\n0 1 0\n",
                           b"DATA binary_compressed\n" + bytes([9, 0, 0, 0, 36, 0, 0, 0, 5]),
                           "damaged or cut off", "export the file again"),
    "compressed to a huge size": (b"DATA ascii\n0 0 0\n1 0 0\n0 1 0\n",
                                  b"DATA binary_compressed\n" + b"\xff" * 16,
                                  "damaged or cut off", "export the file again"),
}  # fmt: skip

OFF = b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
OFF_CHANGES = {
    "no word": (b"OFF\n", b";\n", "line 1: ''", "export the file again"),
    "no magic": (b"OFF", b"FOO", "line 1: 'FOO'", "export the file again"),
    "no counts": (b"3 1 0\n", b"x 1 0\n", "line 2 states no number of vertices", "export the file"),
    "negative count": (b"3 1 0\n", b"-3 1 0\n", "states no number of vertices", "export the file"),
    "fewer than announced": (b"3 1 0", b"9 1 0", "announces 9 points, the file holds 4", "copy or"),
    "more than announced": (b"3 1 0", b"2 1 0", "announces 2 points, the file holds 3", "correct"),
    "word": (b"1 0 0", b"1 x 0", "line 4: 'x'", "correct or remove that line"),
    "nan": (b"1 0 0", b"1 nan 0", "in 1 of 3 points, first in line 4", "--drop-invalid"),
    "short row": (b"1 0 0", b"1 0", "line 4 has 2 values", "the same number of values"),
    "four dimensions": (b"OFF", b"4OFF", "line 1: '4OFF'", "export the file again"),
}


def _npy(array: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.asarray(array), allow_pickle=True)
    return stream.getvalue()


def _mat(**arrays: object) -> bytes:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, arrays)
    return stream.getvalue()


OBJECTS = np.array([[None, {}]], dtype=object)
NPY: dict[str, tuple[bytes, str, str]] = {
    "one axis": (_npy(np.zeros(4)), "shape (4,)", "points go in rows"),
    "three axes": (_npy(np.zeros((2, 2, 2))), "shape (2, 2, 2)", "points go in rows"),
    "four columns": (_npy(np.zeros((5, 4))), "shape (5, 4)", "with 2 or 3 columns"),
    "transposed": (_npy(np.zeros((2, 9))), "shape (2, 9)", "looks transposed"),
    "a number": (_npy(3.0), "shape ()", "points go in rows"),
    "no rows": (_npy(np.zeros((0, 2))), "holds no points", "give a file with at least one"),
    "nan": (_npy([[1.0, np.nan]]), "first in point 0", "remove these points"),
    "infinity": (_npy([[1.0, 2.0], [np.inf, 0]]), "first in point 1", "remove these points"),
    "text": (_npy([["a", "b"]]), "type <U1", "store real numbers"),
    "complex": (_npy([[1j, 2.0]]), "type complex128", "store real numbers"),
    "truth values": (_npy([[True, False]]), "type bool", "store real numbers"),
    "objects": (_npy(OBJECTS), "is not a readable .npy file (it holds objects", "save it again"),
    "records": (_npy(np.zeros(2, "f8,f8")), "store real numbers", "type"),
    "cut off": (_npy(A2)[:-8], "is not a readable .npy file", "save it again"),
    "archive": (npz(a=A2), "holds several arrays", "rename it to .npz"),
    "text file": (
        b"1 2\n3 4\n",
        "is not a readable .npy file (it holds objects or no array)",
        "save",
    ),
}
NPZ = {
    "no arrays": (npz(), "holds no numeric array", "arrays found: none"),
    "no cloud": (npz(a=np.zeros(3)), "holds no numeric array", "arrays found: a"),
    "two clouds": (npz(a=A2, b=A2), "several arrays can be point clouds: a, b", "--source-key"),
    "objects": (npz(a=OBJECTS), "holds no numeric array", "arrays found: a"),
    "cut off": (npz(a=A2)[:-40], "is not a readable .npz file", "save it again"),
    "single array": (_npy(A2), "holds a single array", "rename it to .npy"),
    "text file": (b"1 2\n", "is not a readable .npz file", "save it again"),
    "nan": (npz(a=np.full((3, 2), np.nan)), "NaN or infinity in 3 of 3", "remove these"),
}
MAT = {
    "no arrays": (_mat(), "holds no numeric array", "arrays found: none"),
    "no cloud": (_mat(a=np.zeros((4, 4))), "holds no numeric array", "arrays found: a"),
    "two clouds": (_mat(a=A2, b=A2), "several arrays can be point clouds", "--source-key"),
    "text": (_mat(a="words"), "holds no numeric array", "arrays found: a"),
    "cut off": (_mat(a=A2)[:150], "is not a readable .mat file", "save -v7"),
    "version 7.3": (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(64),
                    "is not a readable .mat file", "save -v7"),
    "text file": (b"1 2\n", "is not a readable .mat file", "save it again with: save -v7"),
    "nan": (_mat(a=np.full((3, 2), np.nan)), "NaN or infinity in 3 of 3", "remove these"),
}  # fmt: skip
EMPTY = {".npy": "save it again", ".npz": "save it again", ".mat": "save -v7"}
EMPTY |= {".txt": "give one point", ".csv": "give one point", ".xyz": "give one point"}
PACKAGES = {".las": "laspy", ".laz": "laspy", ".e57": "pye57"}  # which need not be installed
UNREADABLE = [suffix for suffix, package in PACKAGES.items() if find_spec(package) is None]
EMPTY |= dict.fromkeys(PACKAGES, "save it again") | dict.fromkeys(UNREADABLE, "pip install")


def _case(name: str, file: str, content: bytes | None, *words: str) -> Case:
    """A bad source; the target for half of the names, so that both are met."""
    which = "target" if len(name) % 2 else "source"
    run = register(**{which: file})
    return Case("files", name, run, [file, *words], {file: content})


def _changed(
    suffix: str, good: bytes, changes: dict[str, tuple[bytes, bytes, str, str]]
) -> Iterator[Case]:
    for name, (old, new, *words) in changes.items():
        assert old in good, name
        yield _case(f"{suffix} {name}", f"bad{suffix}", good.replace(old, new, 1), *words)


def _cases() -> Iterator[Case]:
    for suffix in READERS:
        file = f"bad{suffix}"
        absent = register(source=file)
        yield Case("files", f"{suffix} missing", absent, [file, "no such file", "check the path"])
        yield _case(f"{suffix} folder", file, None, "is a folder", "give the path of a point file")
        yield _case(f"{suffix} empty", file, b"", EMPTY.get(suffix, "export the file again"))
        noise = np.random.default_rng(0).bytes(4000)
        remedy = "sav" if suffix in EMPTY or suffix == ".off" else "export"
        remedy = "pip install" if suffix in UNREADABLE else remedy
        yield _case(f"{suffix} noise", file, noise, remedy)
    for suffix in (".txt", ".csv", ".xyz"):
        for name, (content, *words) in (TEXT | (NARROW if suffix != ".xyz" else {})).items():
            yield _case(f"{suffix} {name}", f"bad{suffix}", content, *words)
    yield from _changed(".ply", PLY, PLY_CHANGES)
    yield from _changed(".pcd", PCD, PCD_CHANGES)
    yield from _changed(".off", OFF, OFF_CHANGES)
    little = PLY[: PLY.index(b"end_header")].replace(b"ascii", b"binary_little_endian")
    points = little[: little.index(b"element face")] + b"end_header\n"
    for name, body, found in (("cut off", bytes(48), 2), ("too long", bytes(96), 4)):
        words = f"announces 3 points, the file holds {found}", "export the file again"
        yield _case(f".ply binary {name}", "bad.ply", points + body, *words)
    faces = (
        b"ply\nformat binary_big_endian 1.0\nelement face 4\nproperty list uchar int i\n"
        b"element vertex 1\nproperty float x\nproperty float y\nend_header\n\x03\x00"
    )
    yield _case(".ply faces cut off", "bad.ply", faces, "within element 'face'", "export the file")
    tables: list[tuple[str, dict[str, tuple[bytes, str, str]]]] = [
        (".npy", NPY), (".npz", NPZ), (".mat", MAT),
    ]  # fmt: skip
    for suffix, table in tables:
        for name, (content, *words) in table.items():
            yield _case(f"{suffix} {name}", f"bad{suffix}", content, *words)
    packers: list[tuple[str, Callable[..., bytes]]] = [(".npz", npz), (".mat", _mat)]
    for suffix, pack in packers:
        file = f"bad{suffix}"
        for name, key, words in (
            ("unknown key", "z", ["has no array 'z'", "choose one of: a, t"]),
            ("key of text", "t", ["array 't' holds objects or text", "store real numbers"]),
        ):
            run = register(source=f"{file}:{key}")
            yield Case("files", f"{suffix} {name}", run, [file, *words], {file: pack(a=A2, t="w")})
    for suffix in (".pts", ".stl", ".obj", ".xlsx", ".json", ".gz", ".ply2", ""):
        words = f"unknown extension '{suffix}'", "use one of: .txt .csv"
        yield _case(f"unknown extension {suffix or 'none'}", f"bad{suffix}", b"1 2\n", *words)
    for suffix in (".txt", ".ply", ".npy"):
        file = f"good{suffix}"
        words = [file, "key 'k' given", "drop the key"]
        yield Case("files", f"key of {suffix}", register("--source-key", "k", source=file), words)
    yield Case("files", "wrong dimension 3", register(source="a3.txt"),
               ["a3.txt", "3 coordinates", "--model rigid3d"])  # fmt: skip
    yield Case("files", "wrong dimension 2", register(dim=3, target="a2.txt"),
               ["a2.txt", "2 coordinates", "--model similarity2d"])  # fmt: skip
    for name, huge in (("one", {"source": "huge.txt"}),
                       ("both", {"source": "huge.txt", "target": "huge.txt"})):  # fmt: skip
        content = "\n".join(f"{x:g} {y:g}" for x, y in 1e300 * A2).encode()
        yield Case("files", f"huge coordinates in {name}", register(**huge),
                   ["source:", "e+299", "in a larger unit"], {"huge.txt": content})  # fmt: skip
    content = "\n".join(f"{x:g} {y:g}" for x, y in 1e-300 * A2).encode()
    for role in ("source", "target"):
        yield Case("files", f"tiny coordinates in {role}", register(**{role: "tiny.txt"}),
                   [f"{role}: the extent", "e-301", "in a smaller unit"],
                   {"tiny.txt": content})  # fmt: skip


CASES = list(_cases())
