"""The official 3DMatch lists: their grid, shared matches, and both recalls."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines._shared import front_ends
from baselines.contract import Limits
from data.contract import RawInstance, UnknownNameError
from data.registry import dataset
from data.threedmatch.loader import read_csv
from dcreg.status import Status
from reports.threedmatch import draw
from workflows import config
from workflows.config import DatasetSettings, Experiment, MethodSettings, parse_selection
from workflows.instances import Problem, content_digest, read_problems, write_problems
from workflows.metrics import METRICS, Case
from workflows.stages import generate
from workflows.stages.plan import InstanceSpec, expand, method_identity, run_identity
from workflows.studies.threedmatch import against_overlap, not_attempted, recalls, with_pairs

load = cache(config.load)  # a second each
LISTS = ("threedmatch", "threedlomatch", "threedmatch_oriented")
MATCHES = np.column_stack([np.arange(30), np.arange(30)])


def experiment(test, **method):
    levels = list(dataset("threedmatch").tests()[test].levels)
    grid = DatasetSettings(dataset="threedmatch", tests={test: levels}, trials=290)
    methods = [MethodSettings(name="a", baseline="dcreg", **method)]
    return Experiment(name="e", datasets=[grid], methods=methods)


@pytest.mark.parametrize(
    ("test", "count"),
    [
        ("3DMatch", 1623),
        ("3DLoMatch", 1781),
        ("3DMatch-quick", 102),
        ("3DLoMatch-quick", 112),
        ("3DMatch-quick-oriented", 102),
    ],
)
def test_plan_has_every_pair_of_a_list_once(test, count):
    plan = expand(experiment(test))
    instances = [instance for chunk in plan.chunks for instance in chunk.instances]
    pairs = dataset("threedmatch").pairs
    named = [pairs[i.shape, i.test, i.level, i.trial] for i in instances]
    rows = [row for row in read_csv("lists.csv") if row["set"] == test.split("-")[0]]
    wanted = rows[::16] if "-quick" in test else rows
    assert len(instances) == len(wanted) == count
    assert sorted(map(str, named)) == sorted(map(str, wanted))


def test_configs_have_every_pair_of_every_list():
    planned = Counter(
        instance.test
        for name in LISTS
        for part in (name, f"{name}-quick")
        for chunk in expand(load(part), parse_selection(["methods=ransac"])).chunks
        for instance in chunk.instances
    )
    planned["3DLoMatch"] //= 2  # alone, and with the other list
    # every list of the dataset, but the quick list of 3DLoMatch with oriented normals
    lists = [test for _, test, *_ in dataset("threedmatch").pairs if test != "overlap"]
    assert Counter(lists) - planned == {"3DLoMatch-quick-oriented": 112}
    assert not planned - Counter(lists)


def test_all_methods_on_nearest_matches_get_as_many():
    most = {
        method.name: method.options.get("max_pairs")
        for method in load("threedmatch").methods
        if method.options.get("front_end") == "shared-nearest"
    }
    assert "dcreg-nearest" in most
    assert set(most.values()) == {5000}


@pytest.mark.parametrize("name", LISTS)
def test_quick_part_leaves_out_slow_variants_but_no_method(name):
    methods, quick = load(name).methods, load(f"{name}-quick").methods
    kept = [method.name for method in quick]
    left_out = [method.name for method in methods if method.name not in kept]
    slow = (
        "dcreg-200", "dcreg-nearest-surfaces", "teaser-nearest", "mac-nearest", "turboreg-nearest"
    )  # fmt: skip
    assert tuple(left_out) == slow
    assert {m.baseline for m in methods} == {m.baseline for m in quick}


def test_level_is_the_bin_of_the_overlap():
    for (_, test, level, _), row in dataset("threedmatch").pairs.items():
        if test != "overlap":
            assert level <= float(row["overlap"]) <= level + 0.1 + 1e-9


def test_holes_of_the_grid_are_named():
    with pytest.raises(UnknownNameError, match=r"has no trial 289 of 3DMatch 0\.3; use another"):
        dataset("threedmatch").instance("7-scenes-redkitchen", "3DMatch", 0.3, 289)


def problem(n=30):
    points = np.random.default_rng(0).uniform(-1, 1, (n, 3))
    matches = {"shared-mutual": MATCHES}
    return Problem("i", "rigid3d", points, points + 0.5, (1, 1), 20, 0.1, matches)


def test_matches_travel_with_the_instance_and_count_for_its_hash(tmp_path):
    bare = Problem("j", "rigid3d", np.zeros((4, 3)), np.zeros((5, 3)), (1, 1), 3, 0.1)
    write_problems(tmp_path / "p.npz", [problem(), bare])
    first, second = read_problems(tmp_path / "p.npz")
    np.testing.assert_array_equal(first.matches["shared-mutual"], MATCHES)
    assert set(first.matches) == {"shared-mutual"}
    assert second.matches == {}
    given = first.for_solver(1.0, 0)
    other = replace(first, matches={"shared-mutual": MATCHES[:-1]})
    assert content_digest(given) != content_digest(other.for_solver(1.0, 0))


def test_the_protocols_threshold_and_the_shared_matches_reach_the_problem(monkeypatch):
    given = problem()
    raw = RawInstance(
        given.source, given.target, MATCHES, np.eye(4), (1.0, 1.0),
        noise_bound=0.07, match_radii=(0.1, 0.25), viewpoint=(1.0, 2.0, 3.0),
    )  # fmt: skip
    asked = []

    def shared_matches(*how):
        asked.append(how)
        return {"m": MATCHES}

    monkeypatch.setattr(front_ends, "shared_matches", shared_matches)
    spec = InstanceSpec("threedmatch", "s", "3DMatch", 0.3, 0, None, "rigid3d")
    made = generate.problem_of(spec, raw)
    assert (made.noise_bound, made.matches) == (0.07, {"m": MATCHES})
    assert asked[0][2:] == ((0.1, 0.25), (1.0, 2.0, 3.0))
    plain = generate.problem_of(spec, replace(raw, noise_bound=None, match_radii=None))
    assert plain.noise_bound == generate.noise_bound(raw) != 0.07
    assert plain.matches == {}


def test_method_with_few_points_gets_a_share_of_the_prior():
    given = problem().for_solver(1.0, 0, n_points=10)
    assert given.source.shape == given.target.shape == (10, 3)
    assert given.n_inliers == 7  # 20 of 30
    assert given.matches == {}
    spec = experiment("3DMatch-quick"), experiment("3DMatch-quick", n_points=10)
    assert len({run_identity(method_identity(e, e.methods[0]), "x") for e in spec}) == 2


def test_shared_front_ends_hand_on_the_matches_of_the_instance():
    instance = problem().for_solver(1.0, 0)
    options = {"front_end": "shared-mutual", "max_pairs": 20}
    np.testing.assert_array_equal(front_ends.putative_pairs(instance, options).pairs, MATCHES[:20])
    with pytest.raises(front_ends.FrontEndError, match="shared-nearest: the dataset"):
        front_ends.putative_pairs(instance, {**options, "front_end": "shared-nearest"})
    method = registry.load("teaser", front_end="shared-nearest")
    assert "no shared matches" in method.supports(instance)
    assert registry.load("teaser", front_end="shared-mutual").supports(instance) is None


def test_dcreg_registers_over_shared_matches():
    method = registry.load("dcreg", front_end="shared-mutual")
    instance = problem().for_solver(1.0, 0)
    found = method.solve(instance, Limits(time_s=20.0))
    assert found.status is Status.OPTIMAL
    np.testing.assert_allclose(found.T_target_source[:3, 3], 0.5, atol=1e-9)
    assert found.counters["n_correspondences"] == 30
    # its bounds refer to a cost with a penalty for each unmatched row, not to the objective
    assert found.lower_bound is None
    assert found.upper_bound is None
    fewer = registry.load("dcreg", front_end="shared-mutual", max_pairs=20)
    assert "20 of 30 pairs kept" in fewer.solve(instance, Limits(time_s=20.0)).message
    nearest = registry.load("dcreg", front_end="shared-nearest")
    assert "no shared matches" in nearest.supports(instance)


def test_shared_matches_are_nearest_neighbours_in_order(monkeypatch):
    rng = np.random.default_rng(1)
    features = {20: rng.random((20, 4)), 25: rng.random((25, 4))}
    monkeypatch.setattr(front_ends, "_fpfh", lambda points, *how: features[len(points)])
    lists = front_ends.shared_matches(np.zeros((20, 3)), np.zeros((25, 3)), (0.1, 0.2))
    cost = np.linalg.norm(features[20][:, None] - features[25], axis=2)
    nearest = {(i, int(cost[i].argmin())) for i in range(20)}
    mutual = {(i, j) for i, j in nearest if cost[:, j].argmin() == i}
    assert set(map(tuple, lists["shared-nearest"])) == nearest
    assert set(map(tuple, lists["shared-mutual"])) == mutual
    assert mutual != nearest
    for name in ("shared-mutual", "shared-nearest"):
        assert (np.diff(cost[tuple(lists[name].T)]) >= 0).all()
    several = list(map(tuple, lists["shared-several"]))
    assert several[: len(mutual)] == list(map(tuple, lists["shared-mutual"]))
    assert set(several[:20]) == nearest
    assert set(several) == {(i, int(j)) for i in range(20) for j in np.argsort(cost[i])[:5]}


def test_features_with_oriented_normals_do_not_depend_on_the_pose():
    """The scene rotates about the sensor; without a viewpoint, normals flip with the pose."""
    pytest.importorskip("open3d")
    rng = np.random.default_rng(0)
    walls = [rng.uniform(0, 1, (200, 3)) * np.delete(np.eye(3), k, 0).sum(axis=0) for k in range(3)]
    corner = np.vstack(walls) - 2.0
    turned = corner @ Rotation.random(random_state=rng).as_matrix().T
    change = {}
    for viewpoint in (None, (0.0, 0.0, 0.0)):
        of = [front_ends._fpfh(cloud, (0.2, 0.5), viewpoint) for cloud in (corner, turned)]
        change[viewpoint] = np.abs(of[0] - of[1]).mean(axis=1)
    assert np.median(change[0.0, 0.0, 0.0]) < 0.01
    assert np.median(change[None]) > 1.0


def test_objective_of_whole_clouds_is_left_out():
    few, many = np.zeros((10, 3)), np.zeros((2100, 3))
    for cloud, is_known in ((few, True), (many, False)):
        case = Case(np.eye(4), np.eye(4), cloud, cloud, MATCHES[:5], 5, (1, 1))
        assert np.isfinite(METRICS["objective"].compute(case)) == is_known
        assert METRICS["rmse"].compute(case) == 0.0


def test_both_recalls_are_the_published_ones(tmp_path):
    pairs = dataset("threedmatch").pairs
    whole = [key for key in pairs if key[1] == "3DMatch"]
    scenes = [[key for key in whole if key[0] == scene] for scene, *_ in (whole[0], whole[-1])]
    keys = scenes[0][:30] + scenes[1][:10]
    rows = [dict(zip(("shape", "test", "level", "trial"), key, strict=True)) for key in keys]
    runs = pd.DataFrame(rows).assign(
        method="m", display_name="M", rmse=0.1, rotation_error_deg=1.0, translation_error=0.1,
        status="optimal", outcome="finished", time_solve_s=1.0, machine_id="m", parallel_jobs=1.0,
    )  # fmt: skip
    apart = [abs(int(pairs[k]["ref_i"]) - int(pairs[k]["src_j"])) > 1 for k in keys]
    assert 0 < sum(apart) < len(keys)
    runs.loc[0, "translation_error"] = 0.31  # wrong by pose, right by RMSE
    runs.loc[1, ["rotation_error_deg", "rmse"]] = 15.1, 0.21
    runs.loc[2, ["rmse", "rotation_error_deg", "translation_error"]] = np.nan  # no pose
    absent = {"method": "n", "display_name": "N", "outcome": "unavailable", "message": "no package"}
    planned = pd.concat([runs, runs.head(3).assign(rmse=np.nan, **absent)], ignore_index=True)
    assert not_attempted(planned) == {"N": "no package"}
    none = with_pairs(planned[planned["method"] == "n"], dataset("threedmatch"))
    assert recalls(none).empty
    assert against_overlap(none).empty
    runs = with_pairs(planned, dataset("threedmatch"))
    (row,) = recalls(runs).to_dict("records")
    assert row["recall_pairs_pct"] == pytest.approx(100 * 37 / 40)
    other = planned.assign(time_solve_s=9.0, machine_id="another").head(10)
    (mixed,) = recalls(with_pairs(pd.concat([planned, other]), dataset("threedmatch"))).to_dict(
        "records"
    )
    assert mixed["time_max_s"] == 1.0  # times are those of one machine
    good = [ok and i not in (1, 2) for i, ok in enumerate(apart)]
    shares = sum(good[:30]) / sum(apart[:30]), sum(good[30:]) / sum(apart[30:])
    assert row["recall_scenes_pct"] == pytest.approx(100 * np.mean(shares))
    bins = against_overlap(runs)
    assert (bins["pairs"].sum(), bins["poses"].sum()) == (40, 39)
    draw(bins, tmp_path / "figure", 0.2)
    assert {path.suffix for path in tmp_path.iterdir()} == {".pdf", ".svg"}
