"""Results print themselves, and are written as JSON, CSV and certificates."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.files import as_json, plain, whole_file, write_text
from dcreg.result import Sample
from dcreg.text import listing, table
from tests.results import made_result as result
from tests.results import made_sweep as sweep


def test_a_result_prints_everything_except_the_pairs():
    assert str(result()) == result().summary()
    lines = str(result()).splitlines()
    status, _, verdict = lines[0].partition(" ")
    assert status == "status"
    assert verdict.strip() == (
        "optimal: certified for the similarity pose; the lower bound is 75.0 % of the upper bound"
    )
    pose = [line[17:].split() for line in lines[1:4]]
    assert np.array(pose, dtype=float).tolist() == result().T_target_source.tolist()
    entries = {line[:17].strip(): line[17:] for line in lines}
    assert entries["scale"] == "2"
    assert entries["rotation"] == "90.0000 deg"
    assert entries["RMSE of pairs"] == "0.1 over 100 pairs"
    assert entries["gap"] == ("0.25 (tolerance 0.5); the lower bound is 75.0 % of the upper bound")
    assert entries["objective"] == "1 (before the polish 1.25)"
    assert entries["method"] == "similarity2d, mode paper, bound tight"


def test_weighted_costs_are_not_printed_as_residuals():
    found = result(certificate_scope="similarity pose, weighted points")
    assert "RMS cost         0.1 over 100 pairs" in str(found)
    assert "RMSE" not in str(found)


def test_the_printed_pose_moves_points_with_coordinates_of_maps_to_the_right_place():
    cos, sin = math.cos(1.0), math.sin(1.0)
    pose = np.array([[cos, -sin, 4.5e6 + 1 / 3], [sin, cos, 1 / 7], [0.0, 0.0, 1.0]])
    found = result(T_target_source=pose)
    lines = [line[17:].split() for line in str(found).splitlines()[1:4]]
    apart = np.array(lines, dtype=float) - pose
    assert np.abs(apart @ [5e6, 5e6, 1.0]).max() < 1e-3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"upper_bound": 1e-20, "lower_bound": 0.0, "is_exact": True},
         "; the fit is exact up to rounding"),
        ({"status": dcreg.Status.CONVERGED},
         "converged: a later stage is not certified; certified for the similarity pose"),
        ({"status": dcreg.Status.CONVERGED, "gap_tol": 0.1},
         "converged: method's own end; not certified"),
        ({"status": dcreg.Status.CONVERGED, "lower_bound": 0.0, "gap_tol": 2.0},
         "converged: fits within the tolerance; not certified"),
        ({"status": dcreg.Status.CONVERGED, "lower_bound": 0.0, "gap_tol": 2.0, "max_rms": 0.09},
         "converged: method's own end; not certified"),
        ({"status": dcreg.Status.NODE_LIMIT, "max_rms": 0.09},
         "node_limit: best pose so far, not certified"),
        ({"status": dcreg.Status.CONVERGED, "lower_bound": 0.0, "gap_tol": 2.0, "max_rms": 0.11},
         "converged: a pose within max_rms was found; not certified"),
        ({"status": dcreg.Status.NODE_LIMIT, "lower_bound": 0.0, "gap_tol": 2.0},
         "node_limit: best pose so far, not certified"),
        ({"status": dcreg.Status.NODE_LIMIT}, "a later stage did not finish"),
        ({"certificate_scope": "similarity pose of the sample"},
         "optimal: certified for the similarity pose of the sample; the lower bound is"),
        ({"status": dcreg.Status.NODE_LIMIT, "lower_bound": 0.0},
         "node_limit: best pose so far, not certified"),
    ],
)  # fmt: skip
def test_the_verdict_states_what_is_certified(changes, words):
    assert words in str(result(**changes)).splitlines()[0]


@pytest.mark.parametrize(
    ("deviations", "words"),
    [
        ([0.01, 0.2, 0.3, 0.0], "rotation 0.573 deg, translation 0.2 0.3 (in source coordinates)"),
        ([0.01, 0.2, 0.3, 0.005], "rotation 0.573 deg, translation 0.2 0.3, scale 0.5 % (in"),
    ],
)
def test_standard_deviations_are_printed(deviations, words):
    entries = dict(result(covariance=np.diag(deviations) ** 2).entries())
    assert words in entries["uncertainty"]
    assert "open directions" not in entries
    solid = np.eye(4)
    free = result(T_target_source=solid, covariance=np.diag([0.01] * 3 + [0.2] * 3 + [0.005]) ** 2)
    words = "rotation 0.573 0.573 0.573 deg, translation 0.2 0.2 0.2, scale 0.5 %"
    assert words in dict(free.entries())["uncertainty"]
    assert "uncertainty" not in dict(result().entries())


def test_stages_are_listed_if_several_have_bounds():
    search = dcreg.Stage("search", 1.0, 5, 9, dcreg.Status.OPTIMAL, 0.5, 1.0)
    turn = dcreg.Stage("rotation", 1.5, 7, 9, dcreg.Status.TIME_LIMIT, 2.0, 9.0)
    polish = dcreg.Stage("polish", 0.1, objective_before=2.0, objective_after=1.0)
    text = str(result(stages=[search, turn, polish]))
    assert "search stage     optimal, bounds [0.5, 1] (50.0 %), 5 nodes, 1.00 s" in text
    assert "rotation stage   time_limit, bounds [2, 9] (22.2 %), 7 nodes, 1.50 s" in text
    assert "polish stage" not in text
    exact = replace(search, lower_bound=0.0, upper_bound=1e-20)
    assert "optimal, bounds [0, 1e-20] (exact fit), 5 nodes" in exact.summary()
    assert "search stage" not in str(result(stages=[search, polish]))


def test_representations_are_one_short_line():
    assert repr(result()) == (
        "<Result optimal: similarity2d, mode paper, 100 pairs, bounds [0.75, 1], RMSE 0.1>"
    )
    assert repr(sweep()) == "<SweepResult optimal: 3 values of n_inliers from 50 to 70>"


@pytest.mark.parametrize(
    ("rotvec", "degrees"), [((0, 0, 0.1), 5.7296), ((0, np.pi, 0), 180), ((0, 0, 0), 0)]
)
def test_rotation_angle_in_3d(rotvec, degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    assert result(T_target_source=T).rotation_deg == pytest.approx(degrees, abs=1e-4)


def test_rotation_angle_in_2d_is_signed():
    T = np.array([[0.0, 3.0, 0.0], [-3.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert result(T_target_source=T).rotation_deg == pytest.approx(-90)


def test_json_has_every_key_and_null_for_what_is_unknown(tmp_path):
    unknown = result(lower_bound=-math.inf, n_nodes=np.int64(7))
    unknown.write_json(tmp_path / "a.json", source="a.txt")
    content = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert set(content) == {*unknown.to_dict(), "source", "dcreg_version"}
    assert content["lower_bound"] is None
    assert (content["n_nodes"], content["source"]) == (7, "a.txt")
    assert content["T_target_source"] == unknown.T_target_source.tolist()


def test_a_trace_without_a_pose_is_still_json(tmp_path):
    before = dcreg.Event("bound", "search", 0.1, 16, 16, 16, 0.0, math.inf)
    dcreg.Trace([before]).write_jsonl(tmp_path / "trace.jsonl")
    (line,) = (tmp_path / "trace.jsonl").read_text().splitlines()
    row = json.loads(line, parse_constant=pytest.fail)  # Infinity is not JSON
    assert row["upper_bound"] is None
    assert row["stage"] == "search"


def test_a_certificate_is_written_if_one_was_recorded(tmp_path):
    with pytest.raises(dcreg.InputError, match="certificate=True"):
        result().write_certificate(tmp_path / "a.npz")
    points = np.random.default_rng(0).random((8, 2))
    options = dcreg.SolveOptions(certificate=True)
    found = dcreg.register(points, points, n_inliers=8, model="similarity2d", options=options)
    found.write_certificate(tmp_path / "a.npz")
    assert dcreg.verify(tmp_path / "a.npz", points, points).accepted


def test_a_sweep_prints_its_table_and_the_suggestion():
    assert str(sweep()) == sweep().summary()
    heading, *rows, legend, hint = str(sweep()).splitlines()
    assert heading.split()[:2] == ["pairs", "status"]
    assert [row.split()[0] for row in rows] == ["50", "*", "70"]
    assert "0.09487 to 0.1" in rows[0]
    assert legend.startswith("bounds on: similarity pose; proven: lower bound in % of the upper")
    assert "90.0 %" in rows[0]
    assert hint.startswith("suggestion (*), not proven: 60 pairs; beyond this number")
    assert "suggestion: none" in str(sweep(*2 * [dcreg.Status.OPTIMAL]))
    assert "RMSE of pose" not in heading
    space = {"T_target_source": np.eye(4), "model": "rigid3d"}
    assert "RMSE of pose" in str(sweep(**space))


def test_a_sweep_calls_an_exact_fit_exact():
    found = sweep()
    first, *others = found.results
    exact = replace(first, lower_bound=0.0, upper_bound=1e-30, is_exact=True)
    row = str(replace(found, results=[exact, *others])).splitlines()[1]
    assert "exact fit" in row
    assert "100 %" not in row


def warned(**lines):
    """A sweep over 50, 60 and 70 pairs with these warnings (by ``k50`` …)."""
    found = sweep()
    results = [replace(r, warnings=lines.get(f"k{r.n_inliers}", [])) for r in found.results]
    return replace(found, results=results)


def test_a_sweep_gives_every_warning_once():
    assert warned().warnings == []
    same = warned(k50=["too vague"], k60=["too vague"], k70=["too vague"])
    assert same.warnings == ["too vague"]
    assert same.to_dict()["warnings"] == ["too vague"]
    assert str(same).splitlines()[-1] == "warning: too vague"
    some = warned(k60=["rmse 0.12 of 60"], k70=["rmse 1.5e-07 of 70", "on a line"])
    assert some.warnings == ["k=60: rmse 0.12 of 60 (likewise k=70)", "k=70: on a line"]
    every = warned(k50=["rmse 1"], k60=["rmse 2"], k70=["rmse 3"])
    assert every.warnings == ["k=50: rmse 1 (likewise all others)"]


def test_bounds_of_a_sample_are_given_per_pair_of_it():
    found = sweep()
    samples = (Sample(8, 9, k) for k in (5, 5, 7))
    results = [replace(r, downsampled=s) for r, s in zip(found.results, samples, strict=True)]
    sampled = replace(found, results=results)
    first, second, _ = sampled.rows()
    assert first["n_inliers"] == 50
    assert first["rms"] == pytest.approx(np.sqrt(0.5 / 5))
    assert first["marginal_cost"] is None  # the same pairs of the sample
    assert second["marginal_cost"] == pytest.approx((9.0 - 0.6) / 2)
    assert "refer to pairs of these (50 as 5, 60 as 5, 70 as 7)" in str(sampled)


def test_a_sweep_is_written_as_json_and_csv(tmp_path):
    sweep().write_json(tmp_path / "a.json", source="a.txt")
    content = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert set(content) == {*sweep().to_dict(), "source", "dcreg_version"}
    sweep().write_csv(tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["n_inliers"] for row in rows] == ["50", "60", "70"]
    assert (rows[0]["proven_by"], rows[2]["marginal_cost"]) == ("", "")
    assert [float(rows[1][f"T0{j}"]) for j in range(3)] == [0.0, -2.0, 5.0]


# --- files and text ---------------------------------------------------------------------------------


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(OSError, match="full"), whole_file(path) as part:  # noqa: PT012
        part.write_text("half")
        raise OSError("disk full")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_plain_values():
    mixed = {"a": np.arange(2), 3: (np.float64("nan"), math.inf, 0.5), "b": [None, True, "x"]}
    assert plain(mixed) == {"a": [0, 1], "3": [None, None, 0.5], "b": [None, True, "x"]}
    assert json.loads(as_json(mixed)) == plain(mixed)
    odd = {"file": "a\udcff.txt", "pose": np.eye(3)[:, ::2], "one": np.array(3.0), "large": 2**70}
    assert json.loads(as_json(odd)) == plain(odd)


def test_columns_of_text():
    assert listing([("a", "1\n2"), ("long", "3")]) == "a     1\n      2\nlong  3"
    assert table(["n", "word"], [["10", "a"], ["9", "bcdef"]], left=["word"]) == (
        " n  word\n10  a\n 9  bcdef"
    )


@pytest.mark.parametrize(
    ("n_boxes", "said"), [(0, "prove that no objective is below 2,"), (1, "below 2 lies in 1 box,")]
)
def test_a_cover_says_what_it_excludes(n_boxes, said):
    stage = dcreg.Stage("triples", 0.1, n_tried=7, n_boxes=n_boxes, outside=2.0)
    assert said in stage.confinement()


def test_a_sweep_with_greedy_pairs_says_why_it_suggests_nothing():
    assert "suggestion (*), not proven: 60 pairs" in str(sweep())
    stages = [dcreg.Stage("pairs", 0.0, greedy_assignment=True)]
    greedy = sweep(stages=stages)
    assert greedy.suggested_n_inliers is None
    assert "none; pairs were chosen greedily" in str(greedy)
