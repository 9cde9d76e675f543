"""Attributes of points from files: every format, bad files, and the options of `dcreg register`."""

import json

import numpy as np
import pytest

import dcreg
from tests.results import run

COLOURS = np.array([[255, 0, 0], [0, 255, 51], [0, 0, 0]], dtype=np.uint8)
POINTS = "0 0 0", "1 0 0", "1 2 0"


def ply(path, kinds, rows):
    """A PLY file of three points with these further properties, as text."""
    names = [f"property float {axis}" for axis in "xyz"] + [f"property {kind}" for kind in kinds]
    head = ["ply", "format ascii 1.0", "element vertex 3", *names, "end_header"]
    body = [f"{point} {' '.join(map(str, row))}" for point, row in zip(POINTS, rows, strict=True)]
    path.write_text("\n".join([*head, *body]) + "\n")
    return path


def pcd(path, field, kind, values, data="ascii"):
    """A PCD file of three points with one further field of 4 bytes."""
    head = [
        f"FIELDS x y z {field}", "SIZE 4 4 4 4", f"TYPE F F F {kind}", "COUNT 1 1 1 1", "WIDTH 3",
        "HEIGHT 1", "POINTS 3", f"DATA {data}",
    ]  # fmt: skip
    if data == "ascii":
        rows = [f"{point} {value}" for point, value in zip(POINTS, values.tolist(), strict=True)]
        path.write_text("\n".join([*head, *rows]) + "\n")
        return path
    record = np.zeros(3, [("x", "<f4", 3), ("value", values.dtype)])
    record["value"] = values
    path.write_bytes("\n".join([*head, ""]).encode() + record.tobytes())
    return path


def test_attributes_are_read_from_text_and_numpy_files(tmp_path):
    (tmp_path / "a.txt").write_text("# grey\n0.5\n0.25\n")
    (tmp_path / "a.csv").write_text("1,2,3,4\n5,6,7,8\n")
    np.save(tmp_path / "a.npy", np.arange(3))
    assert dcreg.read_attributes(tmp_path / "a.txt").tolist() == [[0.5], [0.25]]
    assert dcreg.read_attributes(tmp_path / "a.csv").tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert dcreg.read_attributes(tmp_path / "a.npy").tolist() == [[0], [1], [2]]


def test_colours_and_intensities_are_read_from_ply_files(tmp_path):
    kinds = [f"uchar {name}" for name in ("red", "green", "blue")]
    path = ply(tmp_path / "a.ply", ["float intensity", *kinds], np.c_[[7, 8, 9], COLOURS])
    np.testing.assert_allclose(dcreg.read_attributes(path), COLOURS / 255.0)
    path = ply(tmp_path / "b.ply", [f"float {name}" for name in "rgb"], COLOURS / 255.0)
    np.testing.assert_allclose(dcreg.read_attributes(path), COLOURS / 255.0)
    path = ply(tmp_path / "c.ply", ["ushort scalar_intensity"], [[7], [800], [9]])
    assert dcreg.read_attributes(path).tolist() == [[7.0], [800.0], [9.0]]


def test_attributes_of_a_binary_ply_file(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("blue", "green", "red"))
    record = np.zeros(3, [("x", "<f4", 3), ("c", "u1", 3)])
    record["c"] = COLOURS[:, ::-1]
    (tmp_path / "a.ply").write_bytes(head.encode() + b"end_header\n" + record.tobytes())
    np.testing.assert_allclose(dcreg.read_attributes(tmp_path / "a.ply"), COLOURS / 255.0)


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_packed_colours_and_intensities_are_read_from_pcd_files(data, tmp_path):
    bits = (COLOURS.astype(np.uint32) << [16, 8, 0]).sum(axis=1).astype("<u4")
    for field, kind, values in (("rgb", "F", bits.view("<f4")), ("rgba", "U", bits)):
        path = pcd(tmp_path / "a.pcd", field, kind, values, data)
        np.testing.assert_allclose(dcreg.read_attributes(path), COLOURS / 255.0)
    path = pcd(tmp_path / "a.pcd", "intensity", "F", np.array([0.5, 3.0, 7.0], "<f4"), data)
    assert dcreg.read_attributes(path).tolist() == [[0.5], [3.0], [7.0]]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", "1\n2 3\n", "line 2 has 2 values, expected 1"),
        ("a.txt", "red\n", "line 1: 'red' is not a number"),
        ("a.csv", "", "give one number or one row per point"),
        ("a.las", "", r"unknown extension '.las'; use one of: .txt .csv .npy .ply .pcd"),
    ],
)
def test_bad_attribute_files_are_refused(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(dcreg.InputError, match=f"{name}: .*{message}"):
        dcreg.read_attributes(tmp_path / name)


def test_a_cloud_without_colours_is_refused(tmp_path):
    path = ply(tmp_path / "a.ply", ["float nx"], [[1], [0], [0]])
    message = (
        r"no colours and no intensity \(properties: x, y, z, nx\); give the attributes as a text"
    )
    with pytest.raises(dcreg.InputError, match=message):
        dcreg.read_attributes(path)


@pytest.fixture
def call(tmp_path):
    """A square whose colours turn by one vertex."""
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    np.savetxt(tmp_path / "a.txt", square)
    np.savetxt(tmp_path / "b.txt", np.roll(square, 1, axis=0) + 3.0)
    np.savetxt(tmp_path / "colours.txt", [0.0, 0.2, 0.5, 1.0])
    return (
        *("register", tmp_path / "a.txt", tmp_path / "b.txt", "--model", "similarity2d"),
        *("--n-inliers", "4", "--json", tmp_path / "o.json"),
    )


def sides(*paths):
    names = ("--source-attributes", "--target-attributes")
    return [part for pair in zip(names, paths, strict=False) for part in pair]


def test_attributes_come_from_files(call, tmp_path):
    colours = tmp_path / "colours.txt"
    outcome = run(*call, *sides(colours, colours), "--attribute-scale", "0.5")
    assert outcome.exit_code == 0, outcome.output
    assert "similarity pose, with attributes" in outcome.output
    content = json.loads((tmp_path / "o.json").read_text())
    assert [j for _, j in content["assignment"]] == [0, 1, 2, 3]
    assert content["attribute_cost"] == 0.0


def test_attributes_of_dropped_points_are_left_out(call, tmp_path):
    points = np.loadtxt(tmp_path / "a.txt")
    np.savetxt(tmp_path / "a.txt", [[np.nan, 0.0], *points])
    np.savetxt(tmp_path / "more.txt", [np.nan, 0.0, 0.2, 0.5, 1.0])
    scale, colours = ("--attribute-scale", "0.5"), tmp_path / "colours.txt"
    outcome = run(*call, "--drop-invalid", *sides(tmp_path / "more.txt", colours), *scale)
    assert outcome.exit_code == 0, outcome.output
    outcome = run(*call, "--drop-invalid", *sides(colours, colours), *scale)
    assert outcome.exit_code == 2
    assert "4 numbers for 5 points" in outcome.output


def test_incomplete_attributes_are_refused(call, tmp_path):
    colours = tmp_path / "colours.txt"
    for given, missing in (
        (sides(colours), "--target-attributes: missing; --source-attributes needs"),
        (sides(colours, colours), "--attribute-scale: missing; --source-attributes needs"),
        (["--attribute-scale", "1"], "--source-attributes: missing; --attribute-scale needs"),
    ):
        outcome = run(*call, *given)
        assert outcome.exit_code == 2
        assert missing in outcome.output
    outcome = run(*call, *sides(colours, colours), "--attribute-scale", "-1")
    assert outcome.exit_code == 2
    assert "attributes: scale -1.0 is not a positive number" in outcome.output


def test_the_coordinates_of_a_text_cloud_are_no_attributes(call, tmp_path):
    given = sides(tmp_path / "colours.txt", tmp_path / "b.txt")
    outcome = run(*call, *given, "--attribute-scale", "1")
    assert outcome.exit_code == 2
    assert "--target-attributes: " in outcome.output
    assert "is the cloud itself" in outcome.output
