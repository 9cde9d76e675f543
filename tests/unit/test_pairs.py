"""Pairs of clouds of one's own: a card of four lines, no checksum, no mirror."""

from __future__ import annotations

import numpy as np
import pytest

from data import registry
from data.contract import Card, DataError
from data.loaders import STOCK
from data.registry import read_card
from data.sampling import farthest_points
from dcreg.problem import apply_pose
from workflows.disturb import make_instance
from workflows.stages.generate import sources_digest

CARD = "name: mine\ndim: {dim}\nloader: pairs\nparameters: {{folder: {folder}, tolerance: 0.01}}\n"


def pose(dim: int) -> np.ndarray:
    T = np.eye(dim + 1)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    T[:2, :2] = turn if dim == 3 else 0.8 * turn
    T[:dim, dim] = np.arange(1.0, dim + 1)
    return T


@pytest.fixture(params=[2, 3])
def dim(request) -> int:
    return request.param


@pytest.fixture
def folder(tmp_path, rng, dim):
    """Two pairs of 30 points, the last ten without a partner, in two formats."""
    for name, ending in (("first", "txt"), ("second", "csv")):
        place = tmp_path / "pairs" / name
        place.mkdir(parents=True)
        source = rng.random((30, dim))
        target = apply_pose(pose(dim), source)
        target[20:] += 50.0
        for role, points in (("source", source), ("target", target)):
            delimiter = "," if ending == "csv" else " "
            np.savetxt(place / f"{role}.{ending}", points, delimiter=delimiter)
        np.savetxt(place / "pose.txt", pose(dim))
    return tmp_path / "pairs"


@pytest.fixture
def mine(folder, dim):
    path = folder.parent / "mine" / "card.yaml"
    path.parent.mkdir()
    path.write_text(CARD.format(dim=dim, folder=folder))
    return STOCK["pairs"](read_card(path))


def test_a_pair_without_its_pose_is_named_and_not_left_out(mine, folder):
    (folder / "first" / "pose.txt").unlink()
    with pytest.raises(DataError, match=r"first: no pose\.txt; add it"):
        mine.shapes()


def test_a_folder_of_pairs_becomes_instances_with_their_truth(mine, dim):
    assert mine.shapes() == ["first", "second"]
    for shape in mine.shapes():
        made = make_instance(mine, shape, "pair", 0.0, 0)
        assert len(made.source) == len(made.target) == 30
        assert len(made.pairs) == 20
        np.testing.assert_allclose(made.T_true, pose(dim))
        moved = apply_pose(made.T_true, made.source[made.pairs[:, 0]])
        np.testing.assert_allclose(moved, made.target[made.pairs[:, 1]], atol=1e-9)
        assert made.scale_range == ((0.5, 1.5) if dim == 2 else (1.0, 1.0))


def test_large_clouds_are_thinned_to_points_far_apart(mine, folder):
    made = make_instance(mine, "first", "pair", 0.0, 0, 25)
    assert len(made.source) == 25
    points = np.loadtxt(folder / "first" / "source.txt")
    np.testing.assert_array_equal(made.source, points[farthest_points(points, 25)])


def test_an_edited_cloud_is_noticed(mine, folder, monkeypatch):
    monkeypatch.setattr(registry, "dataset", lambda name: mine)
    before = sources_digest(["mine"])
    assert len(mine.local_files()) == 6
    assert sources_digest(["mine"]) == before
    with (folder / "first" / "source.txt").open("a") as cloud:
        cloud.write("\n")
    assert sources_digest(["mine"]) != before


SPOILT = {
    "no pose": (lambda f: (f / "first/pose.txt").write_text("one two"), "not a matrix of numbers"),
    "small pose": (lambda f: np.savetxt(f / "first/pose.txt", np.eye(2)), "homogeneous matrix of sh"),
    "nan pose": (lambda f: np.savetxt(f / "first/pose.txt", np.eye(4) * np.nan), "homogeneous matri"),
    "two sources": (lambda f: (f / "first/source.csv").touch(), "2 files source.*; keep exactly one"),
    "no target": (lambda f: (f / "first/target.txt").unlink(), "0 files target.*; keep exactly one"),
    "empty cloud": (lambda f: (f / "first/target.txt").write_text(""), "first/target.txt: "),
    "wrong way": (
        lambda f: np.savetxt(
            f / "first/pose.txt", np.linalg.inv(np.loadtxt(f / "first/pose.txt"))
        ),
        "It must map source to target; else raise tolerance",
    ),
}  # fmt: skip


@pytest.mark.parametrize("spoilt", SPOILT)
def test_what_is_wrong_with_a_pair_is_said_with_file_and_remedy(mine, folder, spoilt):
    spoil, expected = SPOILT[spoilt]
    spoil(folder)
    with pytest.raises(DataError) as error:
        make_instance(mine, "first", "pair", 0.0, 0)
    assert "first" in str(error.value)
    assert expected in str(error.value)


def test_clouds_of_another_dimension_are_refused(mine, folder, dim):
    np.savetxt(folder / "first/target.txt", np.random.default_rng(0).random((9, 5 - dim)))
    with pytest.raises(DataError, match=f"have {5 - dim} coordinates, but dim is {dim} in"):
        make_instance(mine, "first", "pair", 0.0, 0)


@pytest.mark.parametrize(
    ("linear", "expected"),
    [
        (np.diag([1.0, -1.0]), "the pose contains a reflection"),
        (np.diag([1.0, 0.5]), "not a rotation times a scale"),
        (np.eye(2) * 3.0, "its scale is 3, not "),
    ],
)
def test_poses_that_no_model_has_are_refused(mine, folder, dim, linear, expected):
    T = np.eye(dim + 1)
    T[:dim, :dim] = linear[0, 0] * np.eye(dim)
    T[:2, :2] = linear
    np.savetxt(folder / "first/pose.txt", T)
    with pytest.raises(DataError, match=expected):
        make_instance(mine, "first", "pair", 0.0, 0)


@pytest.mark.parametrize(
    ("folder", "expected"),
    [("/no/such/folder", "is not a folder; correct it"), ("empty", "no pairs; add folders with")],
)
def test_a_folder_without_pairs_is_refused(tmp_path, folder, expected):
    (tmp_path / "empty").mkdir()
    parameters = {"folder": str(tmp_path / folder), "tolerance": 1}
    card = Card(name="mine", dim=3, loader="pairs", parameters=parameters)
    with pytest.raises(DataError, match=expected):
        STOCK["pairs"](card).shapes()


def test_files_of_others_need_their_terms():
    files = [{"path": "a", "sha256": "0" * 64}]
    with pytest.raises(ValueError, match="licence: missing"):
        Card(name="theirs", dim=3, loader="points", files=files)
