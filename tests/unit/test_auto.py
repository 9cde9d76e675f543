"""The number of pairs that the library chooses: right on planted problems, with evidence."""

import json

import numpy as np
import pytest

import dcreg
from dcreg.assignment.sparse import greedy_count, tree_of
from dcreg.cli.options import Poses, Search
from dcreg.cli.pair import Task, solve
from dcreg.driver import auto
from dcreg.problem import InputError, apply_pose
from dcreg.result_parts import ChosenNumber, ComparedNumber, Sample
from dcreg.status import Status
from tests.results import made_result, run
from tests.unit.test_sweeping import flat, solid

CLOUDS = {"similarity2d": flat(noise=0.01), "rigid3d": solid(noise=0.02)}


@pytest.fixture(scope="module", params=CLOUDS)
def found(request):
    return dcreg.register(*CLOUDS[request.param], model=request.param, node_limit=1)


def test_the_planted_number_is_chosen(found):
    k = found.n_inliers
    assert 19 <= k <= 20
    known = dcreg.register(*CLOUDS[found.model], model=found.model, n_inliers=k, node_limit=1)
    assert found.objective <= known.objective * (1.0 + 1e-6)
    assert found.chosen_number.runner_up is None
    assert not [line for line in found.warnings if line.startswith("n_inliers")]


def test_the_evidence_is_that_of_the_cheapest_pairs(found):
    compared = found.chosen_number.compared
    numbers, rms = zip(*compared, strict=True)
    assert list(numbers) == sorted(set(numbers))
    assert (np.diff(rms) >= 0.0).all()  # the mean of the k cheapest pairs does not decrease with k
    source, target = CLOUDS[found.model]
    value, _ = dcreg.objective(source, target, found.T_target_source, 24)
    assert compared[-1].n_inliers == 24
    assert rms[-1] == pytest.approx(np.sqrt(value / 24), rel=0.05)
    assert found.chosen_number.low <= found.n_inliers <= found.chosen_number.high


def test_the_evidence_is_in_text_and_json(found):
    assert f"number of pairs  {found.n_inliers}, chosen by the library" in str(found)
    content = json.loads(found.to_json())
    evidence = content["chosen_number"]
    assert evidence["compared"][-1]["n_inliers"] == 24
    assert {"low", "high", "runner_up"} < set(evidence)
    assert content["stages"][0]["stage"] == auto.STAGE


def test_few_true_pairs_among_many_points_are_found():
    rng = np.random.default_rng(3)
    source, target = rng.random((60, 3)), rng.random((60, 3))
    target[:13] = source[:13] + 0.003 * rng.standard_normal((13, 3))
    found = dcreg.register(source, target, model="rigid3d", time_limit=5.0)
    assert found.n_inliers == 13
    assert found.rotation_deg < 2.0


def test_all_pairs_of_a_copy_are_matched():
    points = np.random.default_rng(0).random((30, 2))
    result = dcreg.register(points, points + 3.0, model="similarity2d")
    assert (result.n_inliers, result.status) == (30, Status.OPTIMAL)


def test_many_points_are_compared_by_their_neighbours(monkeypatch):
    monkeypatch.setattr(auto, "MANY_PAIRS", 100)
    result = dcreg.register(*CLOUDS["rigid3d"], model="rigid3d", node_limit=1)
    known = dcreg.register(*CLOUDS["rigid3d"], model="rigid3d", n_inliers=20, node_limit=1)
    assert 16 <= result.n_inliers <= 21
    assert np.allclose(result.T_target_source, known.T_target_source, atol=0.1)


def test_no_number_of_neighbours_is_listed_twice(monkeypatch):
    monkeypatch.setattr(auto, "MANY_PAIRS", 100)
    source, target = CLOUDS["rigid3d"]
    result = dcreg.register(source, target[:12], model="rigid3d", node_limit=1)
    numbers = [each.n_inliers for each in result.chosen_number.compared]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 12


def test_near_pairs_are_counted_one_to_one():
    target = np.array([[0.0, 0.0], [1.0, 0.0]])
    points = np.array([[0.0, 0.1], [0.0, -0.2], [1.0, 0.5], [9.0, 9.0]])
    tree = tree_of(target)
    assert [greedy_count(points, tree, reach) for reach in (0.05, 0.2, 0.5, 20.0)] == [0, 1, 2, 2]


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d", "similarity3d"])
@pytest.mark.parametrize("n", [8, 12, 18])
def test_a_few_pairs_of_small_clouds_do_not_win_by_chance(model, n):
    """Any two pairs fit a similarity in 2D exactly, and a few of 18 points fit others well."""
    rng = np.random.default_rng(n)
    source = rng.standard_normal((n, int(model[-2])))
    target = rng.permutation(source + 5.0 + 0.02 * rng.standard_normal(source.shape))
    found = dcreg.register(source, target, model=model, node_limit=1)
    assert found.n_inliers >= n - 1
    moved = apply_pose(found.T_target_source, source)
    assert np.sqrt(((moved - source - 5.0) ** 2).sum(axis=1).mean()) < 0.1


def test_the_smallest_number_is_not_called_the_only_one_that_fits():
    compared = [ComparedNumber(k, 0.1 * k) for k in (3, 4, 5)]
    assert str(ChosenNumber(compared, 3, 3)).startswith("the smallest number compared\n")
    assert str(ChosenNumber(compared, 4, 4)).startswith(
        "no other number compared fits nearly as well\n"
    )


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_the_lower_bound_gives_a_proven_interval(model):
    found = dcreg.register(*CLOUDS[model], model=model, time_limit=5.0)
    distance, at_least, at_most = found.chosen_number.proven
    assert 0 < at_least <= at_most == found.n_inliers - 1
    assert distance == pytest.approx(np.sqrt(found.lower_bound / found.n_inliers))
    asked = dcreg.max_inliers(*CLOUDS[model], distance=distance, model=model, time_limit=2.0)
    assert asked.at_least <= at_most
    assert at_least <= asked.at_most
    assert f"{at_least} to {at_most}" in str(found.chosen_number)


def test_no_interval_is_proven_without_a_lower_bound():
    points = np.random.default_rng(0).random((30, 2))
    found = dcreg.register(points, points + 3.0, model="similarity2d")
    assert found.chosen_number.proven is None  # the fit is exact


def test_unrelated_clouds_are_called_uncertain():
    rng = np.random.default_rng(1)
    clouds = rng.random((40, 2)), rng.random((40, 2))
    assert dcreg.register(*clouds, model="similarity2d", node_limit=1).warnings


def test_only_feasible_pairs_are_counted():
    source, target = CLOUDS["similarity2d"]
    candidates = np.eye(24, dtype=bool)
    candidates[:, 20:] = False
    result = dcreg.register(source, target, model="similarity2d", candidates=candidates)
    assert result.n_inliers == 20
    assert (result.assignment[:, 0] == result.assignment[:, 1]).all()


def test_a_certificate_is_kept_for_the_chosen_number(tmp_path):
    source, target = CLOUDS["similarity2d"]
    options = dcreg.SolveOptions(certificate=True)
    result = dcreg.register(source, target, model="similarity2d", options=options)
    result.write_certificate(tmp_path / "proof.npz")
    assert dcreg.verify(tmp_path / "proof.npz", source, target).accepted


def test_a_choice_that_the_time_limit_cut_says_so(set_clock, monkeypatch):
    clouds = CLOUDS["similarity2d"]

    def poses(choice):
        yield np.eye(3)
        set_clock.now += 100.0

    with monkeypatch.context() as patch:
        patch.setattr(auto._Choice, "_poses", poses)
        result = dcreg.register(*clouds, model="similarity2d", time_limit=20.0)
    assert result.chosen_number.is_cut
    assert "not all poses and numbers were compared" in str(result)
    assert any("time for the choice, 40% of" in line for line in result.warnings)
    enough = dcreg.register(*clouds, model="similarity2d", node_limit=1)
    assert not enough.chosen_number.is_cut


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_a_number_chosen_at_another_pose_is_reported(monkeypatch, angle):
    """The evidence belongs to the pose of the choice, which the search may leave."""
    turned, run = np.eye(3), auto._Choice.run
    turned[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]

    def from_another_pose(choice):
        at, chosen, pose = run(choice)
        return at, chosen, pose @ turned

    monkeypatch.setattr(auto._Choice, "run", from_another_pose)
    result = dcreg.register(*CLOUDS["similarity2d"], model="similarity2d", node_limit=1)
    assert any("at a clearly different pose" in line for line in result.warnings) == bool(angle)


def test_a_stopped_choice_still_gives_a_pose():
    options = dcreg.SolveOptions(listener=lambda event: True)
    result = dcreg.register(*CLOUDS["rigid3d"], model="rigid3d", options=options)
    assert result.status is Status.STOPPED
    assert any("is a guess" in line for line in result.warnings)
    assert np.isfinite(result.T_target_source).all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_rms": 0.1}, "n_inliers: max_rms needs a number of pairs"),
        ({"options": dcreg.SolveOptions(mode="paper")}, "mode 'paper' searches norms"),
        ({"options": dcreg.SolveOptions(bound="dc")}, "mode 'paper' searches norms"),
        (
            {"options": dcreg.SolveOptions(mode="paper", downsample=400)},
            "mode 'paper' searches norms",
        ),
        (
            {"options": dcreg.SolveOptions(downsample=4000)},
            "2,500 x 2,500 points are too many",
        ),
        ({"n_inliers": "most"}, "n_inliers: 'most' is not a number; give a count, a fraction or"),
    ],
)
def test_what_cannot_work_is_refused_before_the_search(settings, words):
    clouds, options = CLOUDS["rigid3d"], settings.get("options")
    if options is not None and options.downsample:
        clouds = [np.random.default_rng(0).random((2500, 3))] * 2
    with pytest.raises(InputError, match=words):
        dcreg.register(*clouds, model="rigid3d", **settings)


def test_command_and_batch_choose_the_number(tmp_path):
    for name, points in zip("ab", CLOUDS["similarity2d"], strict=True):
        np.savetxt(tmp_path / f"{name}.txt", points)
    files = [str(tmp_path / f"{name}.txt") for name in "ab"]
    outcome = run("register", *files, "--model", "similarity2d", "--quiet")
    assert "20, chosen by the library" in outcome.stdout
    row = solve(Task(0, *files, "auto", None, Search("similarity2d"), Poses(), drop_invalid=False))
    assert row["n_inliers"] == "20"


def test_a_sweep_has_default_numbers():
    source, target = CLOUDS["rigid3d"]
    swept = dcreg.sweep(source, target, model="rigid3d", time_limit=0.3)
    assert [each.n_inliers for each in swept.results] == [4, 7, 9, 12, 14, 16, 19, 21, 24]


@pytest.mark.parametrize(("of_sample", "n_inliers", "warned"), [(2, 12, 1), (3, 12, 0), (2, 2, 0)])
def test_a_sample_whose_pairs_determine_no_pose_is_a_warning(of_sample, n_inliers, warned):
    result = made_result(n_inliers=n_inliers, downsampled=Sample(60, 1500, of_sample))
    lines = list(auto.few_sampled_pairs(result))
    assert len(lines) == warned
    assert all("only 2 pairs of 12" in line and "--downsample" in line for line in lines)


def test_the_choice_warns_of_few_sampled_pairs(monkeypatch):
    monkeypatch.setattr(auto, "few_sampled_pairs", lambda result: ["few pairs"])
    found = dcreg.register(*CLOUDS["similarity2d"], model="similarity2d", node_limit=1)
    assert "few pairs" in found.warnings
