"""Registration over given matches: the answer, its bounds against brute force, and bad input."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.driver import matching
from dcreg.families.matches.bound import MatchBound
from dcreg.families.matches.kernels.bounds import rotation_bounds
from dcreg.families.matches.kernels.compatible import caps
from dcreg.families.matches.problem import MatchProblem
from dcreg.families.matches.start import descend
from dcreg.search import Tolerance
from tests.problems import register

REACH = 0.1


def planted(n_right, n_wrong, seed=0, noise=0.0, several=False):
    """Clouds, matches and pose; with `several`, wrong matches use the points of right ones too."""
    rng = np.random.default_rng(seed)
    n = n_right + n_wrong
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-2, 2, 3)
    source = rng.uniform(-1.5, 1.5, (n, 3))
    target = rng.uniform(-1.5, 1.5, (n, 3)) + T[:3, 3]
    moved = source[:n_right] @ T[:3, :3].T + T[:3, 3]
    target[:n_right] = moved + noise * rng.standard_normal(moved.shape)
    rows = np.arange(n)
    matches = np.column_stack([rows, rows])
    if several:
        wrong = np.column_stack([rows, rng.permutation(n)])
        matches = np.vstack([matches, wrong])
    return source, target, matches, T


def box_about(R, half, offset=0.0):
    """The quaternion of a rotation, its largest entry 1, and a box that may be off it."""
    q = np.roll(Rotation.from_matrix(R).as_quat(), 1)
    axis = int(np.argmax(np.abs(q)))
    q /= q[axis]
    lower, upper = q + offset - half, q + offset + half
    lower[axis] = upper[axis] = 1.0
    return q, lower, upper


def bound_of(problem, lower, upper):
    """The bound on the score of a box of rotations."""
    bounds, poses = np.empty(1), np.empty((1, 3, 4))
    rotation_bounds(problem.list, lower[None], upper[None], 0.0, bounds, poses)
    return bounds[0]


def centred(problem, T):
    """The pose `T` about the centre of the source."""
    return np.column_stack([T[:3, :3], T[:3, 3] + T[:3, :3] @ problem.centre])


@pytest.mark.parametrize(("n_right", "n_wrong"), [(30, 70), (25, 125)])
@pytest.mark.parametrize("several", [False, True])
def test_pose_is_found_among_wrong_matches_and_certified(n_right, n_wrong, several):
    source, target, matches, T = planted(n_right, n_wrong, noise=0.01, several=several)
    found = dcreg.register_matches(
        source, target, matches, inlier_distance=REACH, certify=True, time_limit=60
    )
    assert found.status is dcreg.Status.OPTIMAL
    turn = Rotation.from_matrix(found.rotation @ T[:3, :3].T).magnitude()
    assert turn < 0.02
    assert np.linalg.norm(found.translation - T[:3, 3]) < 0.02
    chosen = {tuple(pair) for pair in found.assignment}
    assert {(i, i) for i in range(n_right)} <= chosen
    assert len({i for i, _ in chosen}) == len({j for _, j in chosen}) == found.n_inliers
    moved = source @ found.rotation.T + found.translation
    i, j = found.assignment.T
    assert found.objective == pytest.approx(((moved[i] - target[j]) ** 2).sum())
    assert 0.0 < found.lower_bound <= found.upper_bound


def test_bounds_are_those_that_were_proven():
    """On the whole cost, so that they do not sink below zero and vanish; the score says the same."""
    source, target, matches, T = planted(30, 70, noise=0.01)
    found = dcreg.register_matches(source, target, matches, inlier_distance=REACH)
    penalty = REACH**2 * (100 - found.n_inliers)
    assert found.upper_bound == pytest.approx(found.objective + penalty)
    assert found.status is dcreg.Status.OPTIMAL
    assert found.gap <= found.gap_tol
    assert found.warnings == []  # the answer is sure
    assert found.score == pytest.approx(
        (100 - found.upper_bound / REACH**2, 100 - found.lower_bound / REACH**2)
    )
    residuals = ((source @ T[:3, :3].T + T[:3, 3] - target)[:30] ** 2).sum(axis=1)
    assert (1.0 - residuals / REACH**2).sum() <= found.score.upper_bound
    assert f"no pose scores above {found.score.upper_bound:.5g}" in str(found)
    assert found.to_dict()["score"] == found.score._asdict()


def test_cost_is_that_of_the_best_one_to_one_choice():
    rng = np.random.default_rng(5)
    for _ in range(20):
        source, target = rng.uniform(0, 0.15, (4, 3)), rng.uniform(0, 0.15, (4, 3))
        pairs = np.array([(i, j) for i in range(4) for j in range(4) if rng.random() < 0.6])
        problem = MatchProblem.checked(source, target, pairs, REACH)
        value, chosen = problem.cost(
            np.eye(3, 4, dtype=float) + np.outer(problem.centre, [0, 0, 0, 1])
        )
        best = np.inf
        for size in range(5):
            for some in itertools.combinations(range(len(pairs)), size):
                i, j = pairs[list(some)].T if some else (np.array([], int),) * 2
                if len(set(i)) == len(set(j)) == size:
                    unmatched = problem.max_cardinality - size
                    cost = ((source[i] - target[j]) ** 2).sum() + REACH**2 * unmatched
                    best = min(best, cost)
        assert value == pytest.approx(best)
        assert len(chosen) == len(set(pairs[chosen, 0])) == len(set(pairs[chosen, 1]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("half", [0.02, 0.1, 0.4])
def test_no_pose_of_a_box_scores_above_its_bound(seed, half):
    """Many poses near the planted one, where scores are high, and boxes that hold their rotations."""
    source, target, matches, T = planted(15, 15, seed, noise=0.02, several=True)
    problem = MatchProblem.checked(source, target, matches, REACH)
    rng = np.random.default_rng(seed)
    q, lower, upper = box_about(T[:3, :3], half, rng.uniform(-half, half, 4))
    bound = bound_of(problem, lower, upper)
    for _ in range(300):
        inside = np.clip(q + rng.normal(0, half / 4, 4), lower, upper)
        R = Rotation.from_quat(np.roll(inside, -1)).as_matrix()
        shift = centred(problem, T)[:, 3] + rng.normal(0, 0.02, 3)
        cost, _ = problem.cost(np.column_stack([R, shift]))
        assert problem.max_cardinality - cost / REACH**2 <= bound + 1e-9
    assert bound <= problem.max_cardinality + 1e-9


def test_bounds_get_tight_as_boxes_shrink():
    source, target, matches, T = planted(20, 40, 3, noise=0.01)
    problem = MatchProblem.checked(source, target, matches, REACH)
    _, cost = descend(problem, centred(problem, T))
    score = problem.max_cardinality - cost / REACH**2
    gaps = []
    for half in (0.1, 0.02, 0.004):
        _, lower, upper = box_about(T[:3, :3], half)
        gaps.append(bound_of(problem, lower, upper) - score)
    assert gaps[0] > gaps[1] > gaps[2] >= -0.05
    assert gaps[2] < 0.2 * score


def test_caps_hold_for_every_pose_that_agrees_with_the_match():
    source, target, matches, T = planted(12, 30, 7, noise=0.02, several=True)
    problem = MatchProblem.checked(source, target, matches, REACH)
    highest = np.empty(len(problem.pairs))
    caps(problem.list, highest)
    rng = np.random.default_rng(0)
    checked = 0
    for _ in range(200):
        R = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix() @ T[:3, :3]
        pose = np.column_stack([R, centred(problem, T)[:, 3] + rng.normal(0, 0.03, 3)])
        agrees = problem.residuals(pose) < REACH**2
        cost, _ = problem.cost(pose)
        assert (highest[agrees] >= problem.max_cardinality - cost / REACH**2 - 1e-9).all()
        checked += agrees.sum()
    assert checked > 500


def test_optimum_chooses_among_the_cheapest_matchings_of_its_size():
    """With k chosen, no other k of these feasible pairs are cheaper: against the dense solver."""
    source, target, matches, _ = planted(8, 4, 2, noise=0.02)
    found = dcreg.register_matches(
        source, target, matches, inlier_distance=0.3, rel_gap=0.0, abs_gap=2e-3, time_limit=60
    )
    mask = np.zeros((12, 12), bool)
    mask[tuple(matches.T)] = True
    settings = {"model": "rigid3d", "candidates": mask, "time_limit": 2, "mode": "full"}
    dense = register(source, target, n_inliers=found.n_inliers, **settings)
    assert found.status is dcreg.Status.OPTIMAL
    assert found.objective <= dense.objective + 1e-6
    penalised = dense.objective + 0.3**2 * (12 - found.n_inliers)
    assert found.lower_bound <= penalised + 1e-9


def test_useless_matches_are_left_out_of_the_bound():
    source, target, matches, _ = planted(60, 100, 1, noise=0.01)
    problem = MatchProblem.checked(source, target, matches, REACH)
    bound = MatchBound(problem, (problem.max_cardinality - 55) * REACH**2, Tolerance())
    assert 60 <= bound.n_left < 160


def test_right_matches_within_a_wide_distance_need_no_search():
    """The least squares of all matches cost less than one unselected match."""
    source, target, matches, _ = planted(30, 0, noise=0.01)
    found = dcreg.register_matches(source, target, matches, inlier_distance=0.2)
    assert (found.status, found.n_nodes, found.n_inliers) == (dcreg.Status.OPTIMAL, 0, 30)
    assert found.lower_bound == pytest.approx(found.upper_bound, rel=1e-6)
    assert found.warnings == []
    exact = dcreg.register_matches(source, source + 1.0, matches, inlier_distance=0.2)
    assert exact.is_exact
    assert exact.success


@pytest.mark.parametrize("reach", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("n_wrong", [0, 1])
def test_no_pose_costs_less_than_the_floor(reach, n_wrong, rng):
    source, target, matches, T = planted(12, n_wrong, noise=0.01)
    problem = MatchProblem.checked(source, target, matches, reach)
    assert (problem.floor > 0.0) == (reach > 0.05 and n_wrong == 0)
    assert problem.floor <= reach**2
    for size in (0.0, 1e-3, 1e-2, 0.1):
        moved = np.eye(4)
        moved[:3, :3] = Rotation.from_rotvec(size * rng.standard_normal(3)).as_matrix()
        assert problem.cost(centred(problem, moved @ T))[0] >= problem.floor
    twice = np.vstack([matches, matches[:, [0, 0]] + [0, 1]])
    twice = twice[twice[:, 1] < len(target)]
    assert MatchProblem.checked(source, target, twice, reach).floor == 0.0


def test_a_search_ends_if_no_proof_is_expected(monkeypatch):
    monkeypatch.setattr(matching, "PATIENCE_S", 0.3)
    source, target, matches, _ = planted(30, 0, noise=0.01)
    given = {"inlier_distance": 0.03, "time_limit": 3.0}
    found = dcreg.register_matches(source, target, matches, **given)
    assert found.status is dcreg.Status.CONVERGED
    assert found.reason == "proof not expected soon"
    assert 0.0 < found.lower_bound < found.upper_bound
    assert any("no proof is expected" in line and "certify=True" in line for line in found.warnings)
    asked = dcreg.register_matches(source, target, matches, **given, certify=True)
    assert asked.status is dcreg.Status.TIME_LIMIT


def test_all_wrong_matches_end_by_the_limit_with_bounds_that_hold():
    source, target, matches, _ = planted(0, 120, 4)
    found = dcreg.register_matches(
        source, target, matches, inlier_distance=0.01, time_limit=5, node_limit=100
    )
    assert found.lower_bound <= found.upper_bound
    assert found.n_inliers < 20


def test_without_certificate_nothing_is_claimed():
    source, target, matches, _ = planted(20, 20, 1)
    found = dcreg.register_matches(source, target, matches, inlier_distance=REACH, certify=False)
    assert found.status is dcreg.Status.CONVERGED
    assert found.lower_bound == 0.0
    assert found.n_nodes == 0


def test_listener_receives_the_events_of_both_stages_and_can_stop():
    source, target, matches, _ = planted(20, 60, 1, noise=0.01)
    given = {"inlier_distance": REACH, "rel_gap": 0.0, "abs_gap": 4e-3}
    heard = []
    found = dcreg.register_matches(
        source, target, matches, **given, options=dcreg.SolveOptions(listener=heard.append)
    )
    assert {event.stage for event in heard} == {"start", "rotation"}
    assert heard[-1].status == found.status == dcreg.Status.OPTIMAL
    last = list(found.trace)[-1]
    assert last.upper_bound == heard[-1].upper_bound == found.upper_bound
    assert last.lower_bound == heard[-1].lower_bound == found.lower_bound
    stopped = dcreg.register_matches(
        source, target, matches, **given, options=dcreg.SolveOptions(listener=lambda event: True)
    )
    assert stopped.status is dcreg.Status.STOPPED


def test_starts_that_the_listener_cuts_are_not_reported_as_finished():
    source, target, matches, _ = planted(40, 400, 1, noise=0.01)
    stop = dcreg.SolveOptions(listener=lambda event: True)
    found = dcreg.register_matches(
        source, target, matches, inlier_distance=REACH, certify=False, options=stop
    )
    assert found.status is dcreg.Status.STOPPED
    assert found.stages[0].n_assignments == 1


def test_poses_that_agree_nearly_as_well_give_a_warning():
    source, target, matches, _ = planted(25, 0, noise=0.005)
    elsewhere = np.vstack([target, target[:22] + 5.0])
    twice = np.vstack([matches, [(i, 25 + i) for i in range(22)]])
    found = dcreg.register_matches(source, elsewhere, twice, inlier_distance=REACH, certify=False)
    (line,) = found.warnings
    assert "another pose agrees with the matches nearly as well (88% of the score)" in line
    assert "another pose" in str(found)


def test_matches_that_determine_no_pose_give_a_warning():
    source, target, matches, _ = planted(0, 10, 4)
    found = dcreg.register_matches(source, target, matches, inlier_distance=1e-6, node_limit=20)
    assert 1 <= found.n_inliers < 3
    assert any("do not determine the pose" in line for line in found.warnings)
    assert "do not determine" in str(found)


def test_without_a_selected_match_there_is_no_residual():
    source, target, matches, _ = planted(0, 10, 4)
    found = dcreg.register_matches(source, target, matches, inlier_distance=1e-30, node_limit=20)
    assert found.n_inliers == 0
    assert "nan over 0 pairs" in str(found)
    assert '"rmse_matched": null' in found.to_json()


def test_a_search_that_proves_nothing_gives_a_warning():
    source, target, matches, _ = planted(12, 150, noise=0.02)
    found = dcreg.register_matches(source, target, matches, inlier_distance=REACH, node_limit=16)
    assert found.status is dcreg.Status.NODE_LIMIT
    reached, limit = found.score
    expected = f"up to {limit:.4g} is not ruled out, this one has {reached:.4g}"
    assert any(expected in line and "more time" in line for line in found.warnings)


def test_a_tolerance_above_the_cost_gives_a_warning():
    source, target, matches, _ = planted(20, 20, 1, noise=0.01)
    given = {"inlier_distance": REACH, "abs_gap": 10.0}
    found = dcreg.register_matches(source, target, matches, **given)
    assert found.status is dcreg.Status.CONVERGED
    assert found.lower_bound == 0.0
    assert any("within the tolerance" in line and "Omit abs_gap" in line for line in found.warnings)
    given["certify"] = False
    assert not dcreg.register_matches(source, target, matches, **given).warnings


@pytest.mark.parametrize(("n", "reach", "seed"), [(60, 0.05, 0), (60, 0.2, 0), (200, 0.1, 0)])
def test_an_agreement_by_chance_gives_a_warning(n, reach, seed):
    """In the first two cases no second pose is nearly as good as the best."""
    rng = np.random.default_rng(seed)
    source, target = rng.uniform(-1, 1, (2, n, 3))
    matches = np.column_stack([np.arange(n), rng.permutation(n)])
    found = dcreg.register_matches(
        source, target, matches, inlier_distance=reach, certify=False, time_limit=10
    )
    assert any("nearly as well" in line or "by chance" in line for line in found.warnings)


def test_unit_of_length_does_not_matter():
    source, target, matches, _ = planted(20, 60, 1, noise=0.01)
    small = dcreg.register_matches(source, target, matches, inlier_distance=REACH, certify=False)
    large = dcreg.register_matches(
        1000 * source, 1000 * target, matches, inlier_distance=1000 * REACH, certify=False
    )
    np.testing.assert_allclose(small.rotation, large.rotation, atol=1e-6)
    assert small.n_inliers == large.n_inliers


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"matches": [[0, 0], [1, 1]]}, "2 different ones; a rigid pose needs 3"),
        ({"matches": [[0, 0], [1, 1], [1, 1]]}, "2 different ones"),
        ({"matches": [[0, 0], [1, 1], [2, 99]]}, r"\[2.0, 99.0\] in row 2 is not a pair of rows"),
        ({"matches": [[0, 0], [1, 0.5], [2, 2]]}, "in row 1"),
        ({"matches": [0, 1, 2]}, r"matches: shape \(3,\)"),
        ({"matches": "abc"}, "matches: not an array"),
        ({"inlier_distance": 0.0}, "inlier_distance: 0.0"),
        ({"inlier_distance": np.nan}, "inlier_distance: nan"),
        ({"time_limit": -1.0}, "time_limit"),
        ({"source": np.zeros((3, 2))}, "source: shape"),
    ],
)
def test_bad_input_is_named(change, message):
    points = np.random.default_rng(0).random((10, 3))
    given = {"source": points, "target": points, "matches": [[0, 0], [1, 1], [2, 2]]}
    with pytest.raises(dcreg.InputError, match=message):
        dcreg.register_matches(**{**given, "inlier_distance": 0.1, **change})


@pytest.mark.parametrize(("name", "value"), [("init", np.eye(4)), ("threads", 2)])
def test_an_option_without_effect_is_refused_by_name(name, value):
    points = np.random.default_rng(0).standard_normal((9, 3))
    with pytest.raises(dcreg.InputError, match=f"ignores {name}; set only the listener"):
        dcreg.register_matches(
            points, points, np.tile(np.arange(9), (2, 1)).T, inlier_distance=0.1,
            options=dcreg.SolveOptions(**{name: value}),
        )  # fmt: skip
