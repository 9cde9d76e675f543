"""Methods that search by themselves: no help of the library's search, valid bounds, limits, threads."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from baselines import registry
from baselines._shared import library_search, own_search
from baselines._shared.algorithm1 import algorithm_1
from baselines._shared.relaxations import SingleBoxes
from baselines.contract import Instance, Limits
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import Space
from dcreg.families.rotation3d.space import CloudSpace, Rotation3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import rms_radius
from dcreg.search import Box, Boxes, Budget
from dcreg.status import Status
from tests.oracles import kernels as reference
from tests.oracles.matchings import optimal_similarity

N_PROBLEMS = int(os.environ.get("SMALL_PROBLEMS", "20"))
METHODS = [
    ("dcreg_paper", {}),
    ("rpm_htb", {}),
    ("rpm_htb", {"bound": "termwise-r1"}),
    ("rpm_htb", {"incumbents": "pose"}),
    ("rpm_bp", {}),
    ("hbsp", {}),
]
IN_3D = [("dcreg_paper", {}), ("rpm_htb", {}), ("hbsp", {})]
SPACES = (Space, FeatureSpace, Similarity2D, Translation3D, CloudSpace, Rotation3D)


def instance(dim: int, seed: int = 3, n: int = 6) -> Instance:
    """Return noisy copies of most of `n` points."""
    generator = np.random.default_rng([seed, dim])
    source = generator.standard_normal((n, dim))
    target = source + 0.1 * generator.standard_normal((n, dim))
    target[-1] = generator.standard_normal(dim)
    model, scales = ("similarity2d", (0.5, 1.5)) if dim == 2 else ("rigid3d", (1.0, 1.0))
    return Instance("i", source, target, model, n - 1, scales, 0.05, seed)


@pytest.fixture
def no_help(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse everything by which the library's search finds incumbents."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a search by itself used the library's search")

    for space in SPACES:
        for name in {"start", "starts", "seeds", "score", "refine"} & vars(space).keys():
            monkeypatch.setattr(space, name, refuse)
    monkeypatch.setattr(library_search, "register_problem", refuse)
    monkeypatch.setattr("dcreg.families.protocol.alternate", refuse)
    monkeypatch.setattr("dcreg.families.similarity2d.space.alternate_assignments", refuse)
    # the state of every search of the library, however it is imported
    monkeypatch.setattr(sys.modules["dcreg.search.branch_and_bound"], "Search", refuse)


@pytest.mark.parametrize(
    ("name", "options", "dim"),
    [*((*each, 2) for each in METHODS), *((*each, 3) for each in IN_3D)],
)
def test_own_search_uses_nothing_of_the_library_s(no_help, name, options, dim) -> None:
    solution = registry.load(name, **options).solve(instance(dim), Limits(30.0, nodes=100))
    assert solution.T_target_source is not None
    assert solution.upper_bound > 0.0
    if name != "dcreg_paper":
        with pytest.raises(AssertionError, match="used the library's search"):
            registry.load(name, search="ours").solve(instance(dim), Limits(30.0, nodes=100))


@pytest.mark.parametrize(("name", "options"), METHODS)
def test_no_wrong_optimum_over_a_start_box_that_contains_it(name, options) -> None:
    """The search is over all poses of the box: scales from 0 to the length of its diagonal."""
    n_optimal = 0
    for seed in range(N_PROBLEMS):
        problem = instance(2, seed, 4)
        source, target, k = problem.source, problem.target, problem.n_inliers
        highest, lowest = (
            optimal_similarity(source, target, k, (0.0, top)) for top in (1.5, 1.5 * np.sqrt(2))
        )
        gap_tol = max(0.9 * highest, 1e-3) if seed % 5 else 0.1 * k
        factor = float(np.sqrt(gap_tol / k) / rms_radius(target))
        method = registry.load(name, epsilon_factor=factor, **options)
        found = method.solve(problem, Limits(60.0, nodes=1500 if name == "rpm_htb" else 300))
        slack = 1e-8 * (1 + highest)
        assert found.lower_bound <= highest + slack
        assert found.upper_bound >= lowest - slack
        assert found.gap_tol == pytest.approx(gap_tol)
        if found.status is Status.OPTIMAL:
            n_optimal += 1
            assert found.upper_bound <= highest + gap_tol + slack
            assert found.upper_bound - found.lower_bound <= gap_tol + slack
    print(f"{name} {options}: {n_optimal} of {N_PROBLEMS} certified")


@pytest.mark.parametrize(("name", "options", "dim"), [("rpm_htb", {}, 2), ("rpm_htb", {}, 3)])
def test_bounds_of_single_boxes_are_those_of_the_library_s_search(name, options, dim) -> None:
    """Where the box contains only admissible poses."""
    problem = instance(dim)
    method = registry.load(name, **options)
    space = (
        Similarity2D(problem.source, problem.target, problem.n_inliers, (0.5, 1.5))
        if dim == 2
        else Translation3D(problem.source, problem.target, problem.n_inliers)
    )
    centre = np.array([0.9, 0.1, 0.2, -0.1])[: 4 if dim == 2 else 3]
    box = Box(centre - 0.05, centre + 0.05)
    (found,) = method.bounding(space, 1).evaluate([box])
    assert found.lower_bound == pytest.approx(method.box_bound(problem, box.lower, box.upper))
    assert found.value == pytest.approx(reference.objective(space, found.theta))


@pytest.mark.parametrize("fits", [True, False])
def test_incumbents_are_objectives_at_candidates_of_the_relaxations(fits, monkeypatch) -> None:
    problem = instance(2)
    space = Similarity2D(problem.source, problem.target, problem.n_inliers, (0.5, 1.5))
    method = registry.load("rpm_htb", incumbents="fit" if fits else "pose")
    bound, offered = method.bounding(space, 1), []
    evaluate = SingleBoxes.evaluate

    def recorded(self, boxes):
        found = evaluate(self, boxes)
        for at, box in enumerate(boxes):
            parts = [part.relax(Boxes.of([box])) for part in self.parts]
            thetas = [part.thetas[0] for part in parts]
            if fits:
                thetas += [
                    space.fit_matching(theta, part.matchings[0])
                    for theta, part in zip(thetas.copy(), self.parts, strict=True)
                ]
            values = [reference.objective(space, theta) for theta in thetas]
            assert found[at].value == pytest.approx(min(values), abs=1e-9)
            offered.extend(values)
        return found

    monkeypatch.setattr(SingleBoxes, "evaluate", recorded)
    found = algorithm_1(bound, space.roots(), 1e-9, Budget(nodes=40))
    for event in found.events:
        assert np.abs(np.array(offered) - event.upper_bound).min() < 1e-9


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize(
    ("name", "options", "dim"),
    [*((*each, 2) for each in METHODS), *((*each, 3) for each in IN_3D)],
)
def test_two_threads_give_the_same_result(name, options, dim) -> None:
    method = registry.load(name, **options)
    one, two = (
        method.solve(instance(dim), Limits(60.0, nodes=200, threads=threads)) for threads in (1, 2)
    )
    np.testing.assert_array_equal(one.T_target_source, two.T_target_source)
    assert (one.lower_bound, one.upper_bound) == (two.lower_bound, two.upper_bound)
    assert (one.counters, one.extra["n_nodes_rotation" if dim == 3 else "n_nodes_search"]) == (
        two.counters, two.extra["n_nodes_rotation" if dim == 3 else "n_nodes_search"]
    )  # fmt: skip


@pytest.mark.parametrize(("name", "options"), IN_3D)
def test_both_stages_end_at_the_number_of_assignments(name, options) -> None:
    problem = instance(3, n=10)
    solution = registry.load(name, **options).solve(problem, Limits(60.0, assignments=100))
    assert solution.status is Status.ASSIGNMENT_LIMIT
    ends = {row["stage"]: row for row in solution.trace if row["kind"] == "end"}
    assert set(ends) == {"translation", "rotation"}
    for row in ends.values():
        assert 100 <= row["n_assignments"] <= 150  # checked after both children of a box
    boxes = [solution.extra[f"n_nodes_{stage}"] for stage in ends]
    assert boxes == [row["n_nodes"] for row in ends.values()]
    assert sum(boxes) == solution.counters["n_nodes"]
    assert not any(solution.extra[f"is_optimal_{stage}"] for stage in ends)


def test_a_translation_search_that_ended_says_so() -> None:
    """Claims leave out a rotation at the limit."""
    method = registry.load("dcreg_paper", epsilon_factor=0.3)
    solution = method.solve(instance(3), Limits(4.0))
    stages = [row for row in solution.trace if row["kind"] == "end"]
    assert stages[0]["status"] == "optimal"
    for row in stages:
        assert solution.extra[f"is_optimal_{row['stage']}"] == (row["status"] == "optimal")


def test_clouds_too_large_for_the_rotation_search_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(own_search, "MAX_PAIRS", 30)
    for name, _ in IN_3D:
        assert "6 x 6 point pairs exceed 30" in registry.load(name).supports(instance(3))
    assert registry.load("rpm_htb").supports(instance(2)) is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"search": "theirs"}, "option search = 'theirs'; choose one of own, ours"),
        ({"start_box": "small"}, "choose one of radius, extent, stationary"),
        ({"incumbents": "all"}, "choose one of fit, pose"),
        ({"polish": False}, "has no effect with search: own"),
        ({"search": "ours", "epsilon_factor": 0.1}, "has no effect with search: ours"),
        ({"raise_children": 1}, "is a int"),
    ],
)
def test_options_are_checked(options, said) -> None:
    with pytest.raises(registry.BaselineError, match=said):
        registry.load("rpm_htb", **options)
