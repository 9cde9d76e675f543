"""Readers of every format. The errors of bad files are in `tests.bad_input`."""

import contextlib
import struct
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from dcreg.io import matlab, read_points
from dcreg.io.mesh import lzf_decompress
from dcreg.io.moved import write_moved
from dcreg.problem import InputError

POINTS3 = np.array([[0.5, -1.0, 2.0], [3.25, 4.0, -5.5], [1e-3, 0.0, 7.0], [8.0, 9.0, 10.0]])
POINTS2 = POINTS3[:, :2]


def write(path, text):
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def rows(points, separator=" "):
    return "\n".join(separator.join(repr(float(v)) for v in point) for point in points) + "\n"


# --- text -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("separator", [" ", "\t", ",", ", ", ";", "   "])
@pytest.mark.parametrize("points", [POINTS2, POINTS3], ids=["2d", "3d"])
@pytest.mark.parametrize("header", ["", "# made by hand\n", "x{s}y{s}z\n", "4\n", "\n\n"])
def test_text_forms(tmp_path, separator, points, header):
    header = header.format(s=separator if separator.strip() else " ")
    if points.shape[1] == 2:
        header = header.replace("z", "").rstrip(",; \t\n") + "\n" * header.endswith("\n")
    path = write(tmp_path / "cloud.txt", header + rows(points, separator))
    np.testing.assert_array_equal(read_points(path), points)


def test_line_ends_bom_comments_and_trailing_separator(tmp_path):
    text = "\ufeff4\r\n0.5,-1,2, % first\r\n3.25,4,-5.5, // second\r\n\r\n1e-3,0,7,\r\n8,9,10,\r\n"
    np.testing.assert_array_equal(read_points(write(tmp_path / "a.csv", text)), POINTS3)


def test_old_mac_line_ends(tmp_path):
    path = write(tmp_path / "a.txt", rows(POINTS2).replace("\n", "\r"))
    np.testing.assert_array_equal(read_points(path), POINTS2)


def test_header_names_choose_columns(tmp_path):
    text = 'label,"Z","X","Y"\na,2.0,0.5,-1\nb,-5.5,3.25,4\n'
    np.testing.assert_array_equal(read_points(write(tmp_path / "a.csv", text)), POINTS3[:2])


def test_xyz_reads_the_first_three_columns(tmp_path):
    path = write(tmp_path / "a.xyz", rows(np.hstack([POINTS3, POINTS3 * 7])))
    np.testing.assert_array_equal(read_points(path), POINTS3)


def test_extension_in_capitals(tmp_path):
    np.testing.assert_array_equal(read_points(write(tmp_path / "A.TXT", "1 2\n")), [[1, 2]])


# --- arrays ---------------------------------------------------------------------------------------


def test_npy(tmp_path):
    np.save(tmp_path / "a.npy", POINTS3.astype(np.float32))
    points = read_points(tmp_path / "a.npy")
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, POINTS3.astype(np.float32))
    np.save(tmp_path / "i.npy", np.arange(6).reshape(3, 2))
    np.testing.assert_array_equal(read_points(tmp_path / "i.npy"), [[0, 1], [2, 3], [4, 5]])


def test_pickled_data_are_refused(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was loaded",))

    np.save(tmp_path / "a.npy", np.array([Trap(), 1], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"not a readable \.npy"):
        read_points(tmp_path / "a.npy")
    trap = np.array([[Trap(), 1]], dtype=object)
    np.savez(tmp_path / "a.npz", trap=trap, cloud=POINTS3)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npz"), POINTS3)
    with pytest.raises(InputError, match="holds objects"):
        read_points(tmp_path / "a.npz", key="trap")


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_named_arrays(tmp_path, suffix):
    def save(name, **arrays):
        (np.savez if suffix == ".npz" else savemat)(
            tmp_path / name, **({"mdict": arrays} if suffix == ".mat" else arrays)
        )
        return tmp_path / name

    one = save("one" + suffix, cloud=POINTS3, other=np.zeros((1, 7)))
    np.testing.assert_array_equal(read_points(one), POINTS3)
    two = save("two" + suffix, a=POINTS3, b=POINTS2)
    np.testing.assert_array_equal(read_points(f"{two}:b"), POINTS2)
    np.testing.assert_array_equal(read_points(two, key="a"), POINTS3)
    with pytest.raises(InputError, match=f"ambiguous.*a, b; name one, for example 'two{suffix}:a'"):
        read_points(two)


@pytest.mark.parametrize("settings", [{}, {"do_compression": True}, {"format": "4"}], ids=str)
def test_matlab_arrays_are_those_of_scipy(tmp_path, settings):
    rng = np.random.default_rng(0)
    arrays = {
        "f8": rng.random((5, 3)), "f4": rng.random((3, 2)).astype("f4"), "c": np.array([[1j, 2.0]]),
        "l": np.array([[True, False]]), "u1": np.uint8([[1, 255]]), "empty": np.zeros((0, 2)),
        "t": "text",
    }  # fmt: skip
    if "format" not in settings:
        others = {"i8": np.int64([[1, -(2**60)]]), "cell": np.array([[1, "x"]], dtype=object)}
        arrays |= {**others, "struct": {"q": 1}, "cube": rng.random((2, 3, 4))}
    path = tmp_path / "a.mat"
    savemat(path, arrays, **settings)
    with path.open("rb") as stream:
        found = matlab.load(stream)
    expected = {name: value for name, value in loadmat(path).items() if name[:2] != "__"}
    assert list(found) == list(expected)
    for name, array in found.items():
        if array is None:
            assert name in ("cell", "struct", "t")
        else:
            assert array.dtype == expected[name].dtype
            np.testing.assert_array_equal(array, expected[name])


def test_a_matlab_file_that_crashes_scipy_is_refused(tmp_path):
    """The kind of the element of numbers is none."""
    savemat(tmp_path / "a.mat", {"a": POINTS2})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    content[128 + 48] = 0
    with pytest.raises(InputError, match=r"not a readable \.mat file"):
        read_points(write(tmp_path / "b.mat", bytes(content)))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.txt", "²\n1 2\n"),
        ("a.txt", "9" * 5000 + "\n1 2\n"),
        ("a.csv", f'1,"{"2" * 200_000}"\n'),
        ("a.off", "OFF\n² 0 0\n0 0 0\n"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex ²\nproperty float x\nend_header\n"),
    ],
)
def test_counts_that_are_no_digits_or_too_long_are_refused(tmp_path, name, text):
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        read_points(write(tmp_path / name, text))


def test_member_damaged_inside_an_archive(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, cloud=POINTS3)
    content = bytearray(path.read_bytes())
    at = content.index(POINTS3.tobytes()[:8])
    content[at] ^= 0xFF  # the checksum of the member no longer fits
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a readable"):
        read_points(path)


# --- ply ------------------------------------------------------------------------------------------

FACE = b"element face 1\nproperty list uchar int vertex_indices\n"
VERTEX = (
    b"element vertex 4\nproperty uchar red\nproperty float x\nproperty double y\nproperty float z\n"
)


def ply(order, before_vertex):
    """A cloud with a face of list type before or after the vertices."""
    mark = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    elements = FACE + VERTEX if before_vertex else VERTEX + FACE
    header = b"ply\nformat " + order.encode() + b" 1.0\ncomment a, 100% test\n" + elements
    if mark:
        face = struct.pack(mark + "B3i", 3, 0, 1, 2)
        vertices = b"".join(struct.pack(mark + "Bfdf", 200, *point) for point in POINTS3)
    else:
        face = b"3 0 1 2\n"
        vertices = b"".join(b"200 %r %r %r \n" % tuple(map(float, p)) for p in POINTS3)
    body = face + vertices if before_vertex else vertices + face
    return header + b"end_header\n" + body


@pytest.mark.parametrize("before_vertex", [False, True])
@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply(tmp_path, order, before_vertex):
    points = read_points(write(tmp_path / "a.ply", ply(order, before_vertex)))
    np.testing.assert_allclose(points, POINTS3, rtol=1e-7)


def test_ply_without_z_is_2d_and_crlf_header(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float y\nproperty float x\n"
    path = write(tmp_path / "a.ply", (header + "end_header\n2 1\n").replace("\n", "\r\n"))
    np.testing.assert_array_equal(read_points(path), [[1, 2]])


# --- pcd ------------------------------------------------------------------------------------------


def pcd_header(kind, n=4):
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z hist\nSIZE 4 4 8 4 2\nTYPE U F F F I\n"
        f"COUNT 1 1 1 1 2\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {kind}\n"
    ).encode()


def pcd(kind):
    if kind == "ascii":
        body = "".join(f"7 {x!r} {y!r} {z!r} 1 2\n" for x, y, z in POINTS3.tolist()).encode()
    elif kind == "binary":
        body = b"".join(struct.pack("<Ifdf2h", 7, *p, 1, 2) for p in POINTS3)
    else:
        n = len(POINTS3)
        x, y, z = POINTS3.T
        data = struct.pack(f"<{n}I", *[7] * n) + x.astype("<f4").tobytes() + y.tobytes()
        data += z.astype("<f4").tobytes() + struct.pack(f"<{2 * n}h", *[1, 2] * n)
        packed = lzf_compress(data)
        body = struct.pack("<II", len(packed), len(data)) + packed
    return pcd_header(kind) + body


def lzf_compress(data):
    """A simple greedy LZF compressor, written from the description of the format."""
    out, i, literal = bytearray(), 0, bytearray()

    def flush():
        while literal:
            run = literal[:32]
            out.append(len(run) - 1)
            out.extend(run)
            del literal[:32]

    while i < len(data):
        best_length, best_distance = 0, 0
        for distance in range(1, min(i, 8192) + 1):
            length = 0
            while length < 264 and i + length < len(data):
                if data[i + length] != data[i + length - distance]:
                    break
                length += 1
            if length > best_length:
                best_length, best_distance = length, distance
        if best_length < 3:
            literal.append(data[i])
            i += 1
            continue
        flush()
        code, offset = best_length - 2, best_distance - 1
        out.append(min(code, 7) << 5 | offset >> 8)
        if code >= 7:
            out.append(code - 7)
        out.append(offset & 255)
        i += best_length
    flush()
    return bytes(out)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path, kind):
    points = read_points(write(tmp_path / "a.pcd", pcd(kind)))
    np.testing.assert_allclose(points, POINTS3, rtol=1e-7)


def test_numbers_that_become_nan_or_infinity_are_reported_without_a_warning(tmp_path):
    signalling_nan = struct.pack("<I", 0x7F800001)
    header = (
        pcd_header("binary").replace(b"4\nHEIGHT", b"1\nHEIGHT").replace(b"POINTS 4", b"POINTS 1")
    )
    body = struct.pack("<I", 7) + signalling_nan + struct.pack("<df2h", 0, 0, 1, 2)
    with pytest.raises(InputError, match="NaN or infinity in 1 of 1 points"):
        read_points(write(tmp_path / "a.pcd", header + body))
    np.save(tmp_path / "a.npy", np.full((2, 2), np.longdouble("1e4000")))
    with pytest.raises(InputError, match="NaN or infinity in 2 of 2 points"):
        read_points(tmp_path / "a.npy")


def test_pcd_invalid_points_are_reported(tmp_path):
    body = struct.pack("<Ifdf2h", 7, np.nan, 0, 0, 1, 2) * 4
    with pytest.raises(InputError, match="NaN or infinity in 4 of 4 points"):
        read_points(write(tmp_path / "a.pcd", pcd_header("binary") + body))


def test_lzf_known_stream():
    # literal run of 3, then a copy of 7 bytes at distance 3 that overlaps its own end
    assert lzf_decompress(b"\x02abc\xa0\x02", 10) == b"abcabcabca"


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.sampled_from([b"a", b"ab", b"xyz" * 30, b"\0" * 300, b"q"]), max_size=12))
def test_lzf_round_trip(parts):
    data = b"".join(parts)
    assert lzf_decompress(lzf_compress(data), len(data)) == data


# --- off ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "head", ["OFF\n4 1 0\n", "OFF\n# note\n\n4 1\n", "OFF 4 1 0\n", "COFF\n4 1 0\n"]
)
def test_off(tmp_path, head):
    extra = " 255 0 0 255" if head.startswith("C") else ""
    body = rows(POINTS3).replace("\n", extra + "\n")
    path = write(tmp_path / "a.off", head + body + "3 0 1 2\n")
    np.testing.assert_array_equal(read_points(path), POINTS3)


# --- laser scans ----------------------------------------------------------------------------------

IN_A_MAP = POINTS3 + np.array([500_000.0, 5_400_000.0, 300.0])
ROUNDING = 2e-9  # of coordinates of this size


def las(path, points):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-3), np.array([500_000.0, 5_400_000.0, 0.0])
    cloud = laspy.LasData(header)
    cloud.xyz = points
    cloud.write(path)
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las(tmp_path, suffix):
    path = las(tmp_path / f"a{suffix}", IN_A_MAP)
    points = read_points(path)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, IN_A_MAP, rtol=0, atol=ROUNDING)
    pose = np.eye(4)
    pose[:3, 3] = -500_000.0, -5_400_000.0, -300.0
    write_moved(path, pose, tmp_path / "moved.ply")
    np.testing.assert_allclose(read_points(tmp_path / "moved.ply"), POINTS3, rtol=0, atol=ROUNDING)


def test_a_las_file_that_is_cut_off_is_refused(tmp_path):
    path = las(tmp_path / "a.las", IN_A_MAP)
    content, record = path.read_bytes(), 34
    with pytest.raises(InputError, match="announces 4 points, the file holds 3"):
        read_points(write(path, content[:-record]))
    with pytest.raises(InputError, match=r"not a readable \.las file"):
        read_points(write(path, content[:-1]))


def test_e57(tmp_path):
    """Every scan is moved by its pose; invalid points are left out."""
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    quarter = np.array([1.0, 0.0, 0.0, 1.0]) / np.sqrt(2.0)  # about z
    with pye57.E57(str(path), "w") as file:
        for shift, state in ((0.0, [0, 0, 0, 0]), (50.0, [0, 2, 0, 0])):
            columns = {f"cartesian{axis}": POINTS3[:, at] for at, axis in enumerate("XYZ")}
            columns["cartesianInvalidState"] = np.array(state, dtype=np.int8)
            file.write_scan_raw(columns, rotation=quarter, translation=np.array([shift, 5.0, 6.0]))
    x, y, z = POINTS3.T
    turned = np.column_stack([-y, x + 5.0, z + 6.0])
    second = turned[[0, 2, 3]] + [50.0, 0.0, 0.0]
    for key, expected in (("0", turned), ("1", second), (None, np.vstack([turned, second]))):
        np.testing.assert_allclose(read_points(path, key=key), expected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(read_points(f"{path}:1"), read_points(path, key="1"))
    with pytest.raises(InputError, match=r"no scan '2'; choose one of: 0, 1"):
        read_points(f"{path}:2")


@pytest.mark.parametrize("counted", ["records", "chunks"])
def test_damaged_counts_of_a_laz_file_are_refused(tmp_path, counted):
    """With so many records laspy reads for hours; with so many chunks lazrs ends the process."""
    path = las(tmp_path / "a.laz", IN_A_MAP)
    content = bytearray(path.read_bytes())
    start, place = struct.unpack_from("<I", content, 96)[0], 100
    if counted == "chunks":
        place = struct.unpack_from("<q", content, start)[0] + 4  # in the table, after its version
    struct.pack_into("<I", content, place, 2**32 - 2)
    with pytest.raises(InputError, match=f"4294967294 {counted}"):
        read_points(write(path, bytes(content)))


@pytest.mark.parametrize(
    ("suffix", "package", "extra"),
    [(".las", "laspy", "las"), (".laz", "laspy", "las"), (".e57", "pye57", "e57")],
)
def test_a_missing_reader_is_named(tmp_path, monkeypatch, suffix, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    path = write(tmp_path / f"a{suffix}", b"LASF")
    with pytest.raises(InputError, match=rf"package {package}, .* pip install 'dcreg\[{extra}\]'"):
        read_points(path)


def test_a_missing_decompressor_is_named(tmp_path, monkeypatch):
    path = las(tmp_path / "a.laz", IN_A_MAP)
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(InputError, match="package lazrs, which is not installed"):
        read_points(path)


# --- anything -------------------------------------------------------------------------------------


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    suffix=st.sampled_from(
        [".txt", ".xyz", ".npy", ".npz", ".mat", ".ply", ".pcd", ".off"]
        + [".las", ".laz"] * (find_spec("laspy") is not None)
    ),
    seed=st.integers(0, 2**32 - 1),
    data=st.data(),
)
def test_damage_never_escapes_as_another_error(tmp_path, suffix, seed, data):
    """Files with cut or changed bytes give finite points or an InputError, never a crash."""
    content = _valid(tmp_path, suffix, data)
    rng = np.random.default_rng(seed)
    damaged = bytearray(content[: rng.integers(1, len(content) + 1)])
    for at in rng.integers(0, len(damaged), rng.integers(0, 4)):
        damaged[at] = rng.integers(0, 256)
    path = write(tmp_path / f"damaged{suffix}", bytes(damaged))
    with contextlib.suppress(InputError):
        points = read_points(path)
        assert points.ndim == 2
        assert points.shape[1] in (2, 3)
        assert np.isfinite(points).all()


def _valid(tmp_path, suffix, data):
    if suffix == ".ply":
        kinds = ["ascii", "binary_little_endian", "binary_big_endian"]
        return ply(data.draw(st.sampled_from(kinds)), data.draw(st.booleans()))
    if suffix == ".pcd":
        return pcd(data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"])))
    if suffix == ".off":
        return b"OFF\n4 0 0\n" + rows(POINTS3).encode()
    path = tmp_path / f"valid{suffix}"
    if suffix == ".npy":
        np.save(path, POINTS3)
    elif suffix == ".npz":
        np.savez_compressed(path, a=POINTS3)
    elif suffix == ".mat":
        savemat(path, {"a": POINTS3})
    elif suffix in (".las", ".laz"):
        las(path, IN_A_MAP)
    else:
        path.write_text("4\n" + rows(POINTS3))
    return path.read_bytes()


@pytest.mark.parametrize(
    "text", ["1,5;-2,25\n3;,5e1\n", '"1.5","-2.25"\n"3","5"\n', "1.5;-2.25;\n3;5;\n"]
)
def test_decimal_commas_and_quotes_are_read(tmp_path, text):
    points = read_points(write(tmp_path / "a.csv", text.encode()))
    assert points.tolist() == [[1.5, -2.25], [3.0, 5.0]]
