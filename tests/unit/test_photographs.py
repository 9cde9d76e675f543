"""Photographs as point sets: edges, half turns, marks; folders in the form of VOC2007 and Caltech-256."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage import draw, io

from data.contract import DataError, UnknownNameError
from data.fetch import UnavailableError
from data.photographs import edge_points, half_turn
from data.registry import dataset
from dcreg.problem import apply_pose
from workflows.config import load
from workflows.disturb import make_instance
from workflows.instances import Truth, read_truths, write_truths
from workflows.metrics import METRICS, Case
from workflows.stages.generate import problem_of, truth_of
from workflows.stages.plan import InstanceSpec, expand

MIRROR = os.environ.get("DCREG_DATA_MIRROR", "")
needs_mirror = pytest.mark.skipif(
    not Path(MIRROR).is_dir() or not MIRROR, reason="DCREG_DATA_MIRROR names no folder"
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path))
    return tmp_path


def paint(path: Path) -> Path:
    """A white triangle, wider than high, on grey."""
    picture = np.full((120, 200, 3), 90, dtype=np.uint8)
    picture[draw.polygon([20, 100, 95], [30, 60, 180])] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    io.imsave(path, picture, check_contrast=False)
    return path


def test_edges_lie_on_the_outline_in_pixels_x_first(tmp_path):
    points = edge_points(paint(tmp_path / "a.png"), 2.0, 60)
    assert points.shape == (60, 2)
    corners = np.array([[30.0, 20.0], [60.0, 100.0], [180.0, 95.0]])
    for a, b in zip(corners, np.roll(corners, 1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        beside = np.abs((points - a) @ np.array([-along[1], along[0]]))
        assert (beside < 2).sum() >= 10
    assert np.ptp(points[:, 0]) > 1.5 * np.ptp(points[:, 1])


# imageio tries all its plugins on the broken picture: one is deprecated
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_too_few_edges_and_broken_pictures_are_named(tmp_path):
    few = r"a\.png: \d+ edge points at sigma 2, fewer than n_points=5000"
    with pytest.raises(DataError, match=few):
        edge_points(paint(tmp_path / "a.png"), 2.0, 5000)
    (tmp_path / "b.png").write_text("no picture")
    with pytest.raises(DataError, match=r"b\.png: not a readable image"):
        edge_points(tmp_path / "b.png", 2.0, 10)
    gc.collect()  # a file that was left open fails this test, not a later one


def test_a_half_turn_maps_the_picture_onto_itself_upside_down(tmp_path):
    path = paint(tmp_path / "a.png")
    turn = half_turn(path)
    np.testing.assert_array_equal(turn @ turn, np.eye(3))
    np.testing.assert_array_equal(apply_pose(turn, np.array([[0.0, 0.0]])), [[199.0, 119.0]])


def voc(root: Path) -> None:
    place = root / "voc2007/VOCdevkit/VOC2007"
    paint(place / "JPEGImages/000012.jpg")
    paint(place / "JPEGImages/000033.jpg")
    (place / "ImageSets/Main").mkdir(parents=True)
    lines = "000005 -1\n000012  1\n000020  0\n000033  1\n"
    (place / "ImageSets/Main/car_trainval.txt").write_text(lines)


def caltech(root: Path) -> None:
    place = root / "caltech256/256_ObjectCategories"
    for number in (1, 2):
        paint(place / f"145.motorbikes/145_000{number}.jpg")
    (place / "145.motorbikes/RENAME2").write_text("")
    paint(place / "146.mountain-bike/146_0001.jpg")


@pytest.mark.parametrize(
    ("make", "name", "shape", "second"),
    [(voc, "voc2007", "car", "000033.jpg"), (caltech, "caltech256", "motorbikes", "145_0002.jpg")],
)
def test_folders_of_the_public_form_are_read(make, name, shape, second, cache):
    make(cache)
    (path,) = dataset(name).fetch(shape, "turned", 0.0, 1)
    assert path.name == second
    made = make_instance(dataset(name), shape, "turned", 0.0, 1, 40)
    assert made.source.shape == made.target.shape == (40, 2)
    assert made.n_inliers == 36
    np.testing.assert_array_equal(made.T_true, half_turn(path))
    # The same outline, other points of it: near at the reference, but not the same.
    away, _ = cKDTree(made.target).query(apply_pose(made.T_true, made.source))
    assert away.max() < 15
    assert away.min() >= 1
    with pytest.raises(DataError, match="has 2 photographs, so there is no trial 2; lower trials"):
        make_instance(dataset(name), shape, "turned", 0.0, 2, 40)


@pytest.mark.parametrize(("name", "place"), [("voc2007", "VOC2007"), ("caltech256", "256_Ob")])
def test_without_the_folder_the_error_names_what_to_put_where(name, place, cache):
    shape = dataset(name).shapes()[0]
    message = rf"no folder {cache}/{name}.*{place}.* Put the fold"
    with pytest.raises(UnavailableError, match=message):
        make_instance(dataset(name), shape, "turned", 0.0, 0)


@needs_mirror
@pytest.mark.parametrize("shape", dataset("lian_images").shapes())
def test_marks_of_the_first_photograph_are_the_first_of_the_others(shape):
    """The order of the rows is not stated: shuffled rows fit far worse."""
    made = make_instance(dataset("lian_images"), shape, "marked", 2.0, 0)
    source, target = made.judged
    rms = METRICS["rmse_floor"].compute(
        Case(made.T_true, made.T_true, made.source, made.target, made.pairs, 9, made.scale_range)
    )
    assert len(made.pairs) == len(source) < len(made.target)
    assert rms < 0.06 * np.ptp(target, axis=0).max()


@needs_mirror
def test_edges_get_nine_tenths_and_are_evaluated_by_the_marks(tmp_path):
    spec = InstanceSpec("lian_images", "eiffel", "canny", 2.0, 0, 80, "similarity2d")
    raw = make_instance(dataset("lian_images"), *("eiffel", "canny", 2.0, 0, 80))
    assert problem_of(spec, raw).n_inliers_prior == 72
    angle = np.degrees(np.arctan2(raw.T_true[1, 0], raw.T_true[0, 0]))
    assert abs(abs(angle) - 180) < 5
    truth = truth_of(spec, raw)
    plain = Truth("b", raw.T_true, raw.pairs)
    write_truths(tmp_path / "truth.npz", [truth, plain])
    back = read_truths(tmp_path / "truth.npz")
    np.testing.assert_array_equal(back[spec.instance_id].marks, np.hstack(raw.marks))
    assert back["b"].marks is None

    def rmse(T: np.ndarray) -> float:
        case = Case(
            T, raw.T_true, raw.source, raw.target, raw.pairs, 72, raw.scale_range,
            marks=truth.marks,
        )  # fmt: skip
        return METRICS["rmse"].compute(case)

    source, target = raw.marks
    residuals = np.linalg.norm(apply_pose(raw.T_true, source) - target, axis=1)
    assert rmse(raw.T_true) == pytest.approx(np.sqrt((residuals**2).mean()))
    assert rmse(np.eye(3)) > 5 * rmse(raw.T_true)


def test_a_photograph_that_is_not_there_is_not_planned():
    planned = [spec for chunk in expand(load("paper2d_images")).chunks for spec in chunk.instances]
    assert len(planned) == 4 * 2 * 5 - 1
    assert ("eiffel", "marked", 5.0) in [(spec.shape, spec.test, spec.level) for spec in planned]
    with pytest.raises(UnknownNameError, match=r"eiffel has no trial 0 of canny 5; use another"):
        make_instance(dataset("lian_images"), "eiffel", "canny", 5.0, 0)
