"""Clouds that are moved and written: everything but coordinates and normals stays."""

import io
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dcreg
from dcreg.io import READERS
from dcreg.io.mesh import pcd_layout, pcd_records, ply_layout, ply_records
from dcreg.io.moved import PLAIN
from dcreg.io.text import with_fields
from dcreg.names import CLOUD_SUFFIXES, READ_SUFFIXES

POINTS = np.array([[0.5, -1.0, 2.0], [3.25, 4.0, -5.5], [1e-3, 0.0, 7.0], [8.0, 9.0, 10.0]])
# A quarter turn about z, then a shift.
T3 = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
T2 = np.array([[0.0, -2, 5], [2, 0, -1], [0, 0, 1]])
MOVED = POINTS @ T3[:3, :3].T + T3[:3, 3]
MOVED2 = POINTS[:, :2] @ T2[:2, :2].T + T2[:2, 2]
EVERY_FUNCTION = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def write(path, content):
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def moved(source, path, T=T3, **keywords):
    dcreg.write_moved(source, T, path, **keywords)
    return path.read_bytes()


# --- text -----------------------------------------------------------------------------------------


def test_text_keeps_all_that_is_not_a_coordinate(tmp_path):
    text = "# made by hand\nlabel,X,Y,Z\n\na, 1.0 ,2,3 # first\n'b',nan,5,6\r\n\"c,d\",7,8,9\n"
    made = moved(write(tmp_path / "a.csv", text), tmp_path / "b.csv").decode()
    expected = "# made by hand\nlabel,X,Y,Z\n\na,8.0,21.0,33.0 # first\n'b',nan,5,6\n"
    assert made == expected + '"c,d",2.0,27.0,39.0\n'


@pytest.mark.parametrize(
    ("line", "changes", "expected"),
    [
        ("  1 \t2  3 ", {0: "7.5", 2: "8.5"}, "  7.5 \t2  8.5 "),
        ("1;2;note;", {1: "7.5"}, "1;7.5;note;"),
        ("1,5;2;x", {1: "7.5"}, "1,5;7,5;x"),
        ('"a,b",1,2 // end', {2: "7.5"}, '"a,b",1,7.5 // end'),
        ("1,2,", {0: "7.5"}, "7.5,2,"),
    ],
)
def test_fields_of_a_line(line, changes, expected):
    assert with_fields(line, changes) == expected


def test_xyz_keeps_its_columns_and_named_normals_are_rotated(tmp_path):
    write(tmp_path / "a.xyz", "2\n1 2 3 255 0 0\n4 5 6 0 255 0\n")
    made = moved(tmp_path / "a.xyz", tmp_path / "b.xyz").decode()
    assert made == "2\n8.0 21.0 33.0 255 0 0\n5.0 24.0 36.0 0 255 0\n"
    write(tmp_path / "n.csv", "x,y,z,nx,ny,nz\n1,2,3,1,0,0\n4,5,6,nan,0,1\n")
    made = moved(tmp_path / "n.csv", tmp_path / "m.csv").decode()
    assert made == "x,y,z,nx,ny,nz\n8.0,21.0,33.0,0.0,1.0,0.0\n5.0,24.0,36.0,nan,0,1\n"


def test_columns_that_the_new_suffix_does_not_admit_are_left_out(tmp_path):
    write(tmp_path / "a.xyz", "1 2 3 255 0 0\n")
    assert moved(tmp_path / "a.xyz", tmp_path / "b.txt") == b"8.0 21.0 33.0\n"
    assert moved(tmp_path / "a.xyz", tmp_path / "b.csv") == b"x,y,z\n8.0,21.0,33.0\n"


@EVERY_FUNCTION
@given(
    separator=st.sampled_from([" ", "\t", ",", ";"]),
    values=st.lists(st.lists(st.floats(-1e6, 1e6), min_size=5, max_size=5), min_size=1, max_size=5),
)
def test_text_round_trip(tmp_path, separator, values):
    table = np.array(values)
    rows = [separator.join(map(repr, row)) for row in table.tolist()]
    source = write(tmp_path / "a.xyz", "\n".join(rows))
    content = moved(source, tmp_path / "b.xyz").decode()
    found = np.array(
        [line.split(None if separator.isspace() else separator) for line in content.split("\n")]
    )
    np.testing.assert_array_equal(found[:, 3:], [row.split(separator)[3:] for row in rows])
    expected = table[:, :3] @ T3[:3, :3].T + T3[:3, 3]
    np.testing.assert_array_equal(found[:, :3].astype(float), expected)


# --- PLY ------------------------------------------------------------------------------------------

VERTEX = "".join(
    f"property {kind} {name}\n"
    for kind, name in (
        *(("uchar", "red"), ("float", "x"), ("double", "y"), ("float32", "z")),
        *(("float", "nx"), ("float", "ny"), ("float", "nz"), ("short", "label")),
    )
)
FACE = "element face 2\nproperty list uchar int vertex_indices\n"
ORDERS = ("ascii", "binary_little_endian", "binary_big_endian")


def ply(order, before, points=POINTS):
    """Points with colours, normals and labels, and two faces before or after them."""
    mark = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    vertex = f"element vertex {len(points)}\n{VERTEX}"
    header = f"ply\nformat {order} 1.0\ncomment a float of element vertex\n"
    header += f"{FACE}{vertex}end_header\n" if before else f"{vertex}{FACE}end_header\n"
    rows = [(200, *point, 1.0, 0.0, 0.0, -7) for point in points.tolist()]
    if mark:
        faces = struct.pack(mark + "B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
        body = b"".join(struct.pack(mark + "Bfdf3fh", *row) for row in rows)
    else:
        faces = b"3 0 1 2\n4 0 1 2 3\n"
        body = b"".join((" ".join(map(str, row)) + "\n").encode() for row in rows)
    return header.encode() + (faces + body if before else body + faces), faces


def column(content, name):
    """A vertex property of a PLY file."""
    layout = ply_layout(content)
    at = [each.name for each in layout.vertex.properties].index(name)
    return ply_records(content, layout)[f"{at}"]


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("order", ORDERS)
def test_ply_keeps_colours_and_faces_and_rotates_normals(tmp_path, order, before):
    content, faces = ply(order, before)
    made = moved(write(tmp_path / "a.ply", content), tmp_path / "b.ply")
    np.testing.assert_allclose(dcreg.read_points(tmp_path / "b.ply"), MOVED, rtol=1e-6)
    assert len(made.splitlines()[0]) == 3
    assert made.count(faces) == 1
    assert made.index(b"end_header") == content.index(b"end_header")
    if order == "ascii":
        rows = made.decode().split("end_header\n")[1].splitlines()[2 * before :][:4]
        assert all(row.startswith("200 ") and row.endswith(" 0.0 1.0 0.0 -7") for row in rows)
        return
    assert len(made) == len(content)
    assert column(made, "red").tolist() == 4 * [200]
    assert column(made, "label").tolist() == 4 * [-7]
    normals = np.column_stack([column(made, name) for name in ("nx", "ny", "nz")])
    np.testing.assert_array_equal(normals, 4 * [[0.0, 1.0, 0.0]])


@pytest.mark.parametrize("order", ORDERS)
def test_coordinates_that_would_round_become_longer_numbers(tmp_path, order):
    """Scans moved to map coordinates: a number of 4 bytes has steps of half a metre there."""
    content, faces = ply(order, True)
    T = T3.copy()
    T[:3, 3] = 4e6 + 0.125
    made = moved(write(tmp_path / "a.ply", content), tmp_path / "b.ply", T)
    header = made.split(b"end_header")[0].decode()
    assert "comment a float of element vertex\n" in header
    for axis in "xyz":
        assert f"property double {axis}\n" in header
    assert "property float nx\n" in header
    assert faces in made
    expected = POINTS @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(dcreg.read_points(tmp_path / "b.ply"), expected, atol=1e-6)


def test_integers_become_floats(tmp_path):
    header = (
        "ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty int x\nproperty  int  y\n"
        "end_header\n"
    ).replace("\n", "\r\n")
    content = header.encode() + struct.pack(">4i", 1, 2, 3, 4)
    T = np.array([[0.6, -0.8, 0.5], [0.8, 0.6, 0], [0, 0, 1]])
    made = moved(write(tmp_path / "a.ply", content), tmp_path / "b.ply", T)
    assert b"property double x\r\nproperty  double  y\r\n" in made
    expected = [[1, 2], [3, 4]] @ T[:2, :2].T + T[:2, 2]
    np.testing.assert_array_equal(dcreg.read_points(tmp_path / "b.ply"), expected)


@EVERY_FUNCTION
@given(
    order=st.sampled_from(ORDERS),
    before=st.booleans(),
    bad=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 2)), max_size=6),
    seed=st.integers(0, 2**16),
)
def test_invalid_points_of_a_ply_stay(tmp_path, order, before, bad, seed):
    points = np.random.default_rng(seed).normal(size=(9, 3)).astype(np.float32).astype(float)
    for row, axis in bad:
        points[row, axis] = np.nan if axis else -np.inf
    source = write(tmp_path / "a.ply", ply(order, before, points)[0])
    moved(source, tmp_path / "b.ply")
    found = dcreg.read_points(tmp_path / "b.ply", keep_invalid=True)
    expected, valid = points.copy(), np.isfinite(points).all(axis=1)
    expected[valid] = points[valid] @ T3[:3, :3].T + T3[:3, 3]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


# --- PCD ------------------------------------------------------------------------------------------


def pcd(kind, lzf=None):
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z normal_x normal_y normal_z hist\n"
        "SIZE 4 4 4 4 4 4 4 2\nTYPE U F F F F F F I\nCOUNT 1 1 1 1 1 1 1 2\nWIDTH 4\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA {kind}\n"
    )
    rows = [(7, *point, 0.0, 1.0, 0.0, 1, -2) for point in POINTS.tolist()]
    if kind == "ascii":
        return header.encode() + "".join(f"{' '.join(map(str, row))}\n" for row in rows).encode()
    if kind == "binary":
        return header.encode() + b"".join(struct.pack("<I6f2h", *row) for row in rows)
    data = struct.pack("<4I", 7, 7, 7, 7) + POINTS.T.astype("<f4").tobytes()
    data += np.array([4 * [0], 4 * [1], 4 * [0]], "<f4").tobytes() + struct.pack(
        "<8h", *4 * [1, -2]
    )
    packed = b"".join(
        bytes([len(data[at : at + 32]) - 1]) + data[at : at + 32] for at in range(0, len(data), 32)
    )
    return header.encode() + struct.pack("<II", len(packed), len(data)) + packed


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_keeps_its_fields_and_rotates_normals(tmp_path, kind):
    content = pcd(kind)
    made = moved(write(tmp_path / "a.pcd", content), tmp_path / "b.pcd")
    np.testing.assert_allclose(dcreg.read_points(tmp_path / "b.pcd"), MOVED, rtol=1e-6)
    header = content.split(b"DATA")[0]
    assert made.startswith(header + (b"DATA ascii\n" if kind == "ascii" else b"DATA binary\n"))
    if kind == "ascii":
        assert all(row.endswith("-1.0 0.0 0.0 1 -2") for row in made.decode().splitlines()[-4:])
        return
    table = pcd_records(made, pcd_layout(made))
    assert table["0"].ravel().tolist() == 4 * [7]
    assert table["7"].tolist() == 4 * [[1, -2]]
    normals = np.column_stack([table[f"{at}"] for at in (4, 5, 6)])
    np.testing.assert_array_equal(normals, 4 * [[-1.0, 0.0, 0.0]])


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_with_longer_numbers(tmp_path, kind):
    T = T3.copy()
    T[:3, 3] = 4e6
    made = moved(write(tmp_path / "a.pcd", pcd(kind)), tmp_path / "b.pcd", T)
    assert b"\nSIZE 4 8 8 8 4 4 4 2\nTYPE U F F F F F F I\n" in made
    expected = POINTS @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(dcreg.read_points(tmp_path / "b.pcd"), expected, atol=1e-6)


# --- arrays and other formats -----------------------------------------------------------------------


def test_arrays_keep_their_type(tmp_path):
    np.save(tmp_path / "a.npy", POINTS.astype(">f4"))
    moved(tmp_path / "a.npy", tmp_path / "b.npy")
    found = np.load(tmp_path / "b.npy")
    assert found.dtype == ">f4"
    np.testing.assert_allclose(found, MOVED, rtol=1e-6)
    np.save(tmp_path / "i.npy", np.arange(6).reshape(2, 3))
    moved(tmp_path / "i.npy", tmp_path / "j.npy")
    assert np.load(tmp_path / "j.npy").dtype == float


def test_other_arrays_of_an_archive_stay(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", cloud=POINTS, more=POINTS[:2], colours=np.eye(4))
    moved(tmp_path / "a.npz", tmp_path / "b.npz", key="cloud")
    moved(f"{tmp_path / 'a.npz'}:cloud", tmp_path / "c.npz")
    for name in ("b.npz", "c.npz"):
        with np.load(tmp_path / name) as found:
            assert set(found) == {"cloud", "more", "colours"}
            np.testing.assert_array_equal(found["cloud"], MOVED)
            np.testing.assert_array_equal(found["more"], POINTS[:2])


def test_every_suffix_has_a_writer():
    assert set(CLOUD_SUFFIXES) == set(PLAIN) <= set(READERS) == set(READ_SUFFIXES)


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
@pytest.mark.parametrize("old", [".off", ".csv"])
def test_other_formats_get_the_points(tmp_path, old, suffix):
    rows = "\n".join(f"{x},{y}" if old == ".csv" else f"{x} {y} {z}" for x, y, z in POINTS.tolist())
    source = write(tmp_path / f"a{old}", rows if old == ".csv" else f"OFF\n4 0 0\n{rows}\n")
    T, expected = (T2, MOVED2) if old == ".csv" else (T3, MOVED)
    moved(source, tmp_path / f"b{suffix}", T)
    found = dcreg.read_points(tmp_path / f"b{suffix}")
    np.testing.assert_allclose(found, expected, rtol=1e-6 if suffix == ".pcd" else 1e-15)


def test_bad_calls(tmp_path):
    source = write(tmp_path / "a.txt", "1 2\n3 4\n")
    with pytest.raises(dcreg.InputError, match=r"b\.las must end in \.ply or"):
        dcreg.write_moved(source, T2, tmp_path / "b.las")
    with pytest.raises(dcreg.InputError, match=r"shape \(4, 4\) for points with 2 coordinates"):
        dcreg.write_moved(source, T3, tmp_path / "b.txt")
    with pytest.raises(dcreg.InputError, match="finite"):
        dcreg.write_moved(source, T2 * np.nan, tmp_path / "b.txt")
    with pytest.raises(OSError, match="No such file"):
        dcreg.write_moved(source, T2, tmp_path / "absent" / "b.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_the_source_can_be_replaced(tmp_path):
    source = write(tmp_path / "a.txt", "1 2\n3 4\n")
    assert moved(source, source, T2) == b"1.0 1.0\n-3.0 5.0\n"
    stream = io.BytesIO(source.read_bytes())
    assert READERS[".txt"](stream, None).array.tolist() == [[1.0, 1.0], [-3.0, 5.0]]
