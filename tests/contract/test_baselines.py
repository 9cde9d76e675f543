"""Every folder in baselines/ fulfils the contract; methods are found, not listed."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines._shared.poses import homogeneous
from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.problem import apply_pose, rms_radius
from dcreg.status import Status

NAMES = registry.names()
PAIRS = [(name, model) for name in NAMES for model in registry.read_card(name).models]
LIMITS = Limits(time_s=8.0)
MOST_OF_A_STEP = 250  # assignments between two checks of their limit


def easy_instance(model: str) -> Instance:
    """Return a small asymmetric shape, slightly moved, with a few points missing from the target."""
    generator = np.random.default_rng(7)
    if model == "similarity2d":
        angle = np.linspace(0, 2 * np.pi, 26)[:-1]  # a fish-like contour
        body = np.column_stack([np.cos(angle) + 0.4 * np.cos(2 * angle), 0.6 * np.sin(angle)])
        source = 0.4 * body + 0.1 * np.column_stack([np.sin(3 * angle), np.cos(5 * angle)])
        c, s = np.cos(0.3), np.sin(0.3)
        truth = homogeneous(1.1, np.array([[c, -s], [s, c]]), np.array([0.1, -0.05]))
        scale_range = (0.5, 1.5)
    else:
        # A bent, lopsided shell: a surface, since some methods estimate normals or covariances.
        shell = generator.standard_normal((42, 3))
        shell /= np.linalg.norm(shell, axis=1, keepdims=True)
        source = shell * [0.6, 0.4, 0.3] + 0.3 * shell[:, [0]] ** 2 * [0.0, 0.4, 1.0]
        rotation = Rotation.from_rotvec([0.1, -0.15, 0.1]).as_matrix()
        truth = homogeneous(1.0, rotation, np.array([0.05, 0.02, -0.04]))
        scale_range = (1.0, 1.0)
    target = generator.permutation(apply_pose(truth, source))[2:]
    target += 0.002 * generator.standard_normal(target.shape)
    return Instance(
        instance_id=f"easy-{model}",
        source=source,
        target=target,
        model=model,
        n_inliers=len(target),
        scale_range=scale_range,
        noise_bound=0.02,
        seed=11,
    )


def hard_instance(model: str) -> Instance:
    """Return the easy instance with many points displaced, which no search solves at once."""
    easy, generator = easy_instance(model), np.random.default_rng(3)
    target = easy.target.copy()
    moved = generator.permutation(len(target))[::2]
    target[moved] = generator.permutation(target[moved] * [1.0, -0.6, 0.8][: easy.dim])
    return replace(easy, target=target, n_inliers=len(target) // 2)


def runnable(name: str) -> Baseline:
    """Return the method; if it is not installed, check the reason and skip."""
    method = registry.load(name)
    reason = method.available()
    if reason is not None:
        assert_tells_the_remedy(method, reason)
        pytest.skip(f"{name}: {reason}")
    return method


def assert_tells_the_remedy(method: Baseline, reason: str) -> None:
    assert method.card.how_to_get
    assert reason.strip().endswith(method.card.how_to_get) or "front end" in reason
    assert len(reason) > len(method.card.how_to_get), "the reason itself is missing"


@pytest.fixture(scope="module")
def solutions() -> dict[tuple[str, ...], Any]:
    """One run per method and model, shared by the tests that only read it."""
    return {}


class Watched(Instance):
    """An instance that remembers which of its fields were read."""

    def __getattribute__(self, name: str) -> Any:
        if not name.startswith("_"):
            self.__dict__.setdefault("_read", set()).add(name)
        return super().__getattribute__(name)


def solved(solutions: dict, name: str, model: str) -> Solution:
    if (name, model) not in solutions:
        method = runnable(name)
        method.warm_up(easy_instance(model))
        instance = Watched(**vars(easy_instance(model)))
        for points in (instance.source, instance.target):
            points.setflags(write=False)
        solutions[name, model] = method.solve(instance, LIMITS)
        solutions[name, model, "given"] = instance.source, instance.target
        solutions[name, model, "read"] = instance.__dict__["_read"]
    return solutions[name, model]


def test_the_first_set_of_methods_is_found() -> None:
    assert {"dcreg", "rpm_htb", "icp", "cpd", "teaserpp", "kiss_matcher"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
class TestFolder:
    def test_card_is_complete(self, name: str) -> None:
        card = registry.read_card(name)
        for text in (card.display_name, card.summary, card.citation, card.licence):
            assert text.strip()
        assert card.models
        assert card.how_to_get or not card.requires
        assert card.provides_bounds == (card.certifies != "nothing")
        if card.provenance == "reconstruction":
            assert "reconstruction" in card.summary.lower()
            assert "(reconstructed)" in card.display_name

    def test_colour_and_name_are_unique(self, name: str) -> None:
        cards = [registry.read_card(other) for other in NAMES]
        card = registry.read_card(name)
        assert Counter(other.color.lower() for other in cards)[card.color.lower()] == 1
        assert Counter(other.display_name for other in cards)[card.display_name] == 1

    def test_its_parameters_are_accepted(self, name: str) -> None:
        card, idle = registry.read_card(name), registry.load(name).idle_options()
        given = {key: value for key, value in card.parameters.items() if key not in idle}
        assert registry.load(name, **given).options == card.parameters

    def test_its_code_reads_every_parameter(self, name: str) -> None:
        folders = (registry.ROOT / name, registry.ROOT / "_shared")
        files = [registry.ROOT / "contract.py", *(f for at in folders for f in at.rglob("*.py"))]
        code = "".join(file.read_text(encoding="utf-8") for file in files)
        for option in registry.read_card(name).parameters:
            assert f'"{option}"' in code, option

    def test_every_number_has_a_range_that_its_default_lies_in(self, name: str) -> None:
        card = registry.read_card(name)
        for option, default in card.parameters.items():
            entries = default if isinstance(default, list) else [default]
            if any(type(entry) in (int, float) for entry in entries):  # no flags
                assert card.ranges[option].admits(default), option
        for option, admitted in card.ranges.items():
            assert (admitted.above is None) != (admitted.least is None), option
            assert not admitted.admits(-1), option

    def test_options_without_effect_are_refused(self, name: str) -> None:
        card, idle = registry.read_card(name), registry.load(name).idle_options()
        for option, reason in idle.items():
            if option in card.parameters:
                value = card.parameters[option]
                with pytest.raises(registry.BaselineError, match=f"{option} = .*{reason}; leave"):
                    registry.load(name, **{option: value})

    def test_unknown_option_is_refused(self, name: str) -> None:
        with pytest.raises(registry.BaselineError, match="no_such_option"):
            registry.load(name, no_such_option=1)

    def test_available_or_says_how_to_get_it(self, name: str) -> None:
        method = registry.load(name)
        reason = method.available()
        if reason is not None:
            assert_tells_the_remedy(method, reason)

    def test_other_models_are_unsupported_with_a_reason(self, name: str) -> None:
        method = registry.load(name)
        for model in ("similarity2d", "rigid3d"):
            reason = method.supports(easy_instance(model))
            assert (reason is None) == (model in method.card.models)
            assert reason is None or model in reason


@pytest.mark.parametrize(("name", "model"), PAIRS)
class TestSolve:
    def test_card_states_whether_n_inliers_is_used(
        self, solutions: dict, name: str, model: str
    ) -> None:
        solved(solutions, name, model)
        read = solutions[name, model, "read"]
        assert ("n_inliers" in read) == registry.read_card(name).uses_n_inliers

    def test_pose_is_proper(self, solutions: dict, name: str, model: str) -> None:
        solution = solved(solutions, name, model)
        instance = easy_instance(model)
        if solution.T_target_source is None:
            assert solution.status is Status.FAILED
            assert solution.message
            return
        pose, d = solution.T_target_source, instance.dim
        assert pose.shape == (d + 1, d + 1)
        assert np.isfinite(pose).all()
        np.testing.assert_array_equal(pose[d], np.eye(d + 1)[d])
        scale = np.linalg.det(pose[:d, :d]) ** (1 / d)
        low, high = instance.scale_range
        assert low - 1e-9 <= scale <= high + 1e-9
        gram = pose[:d, :d].T @ pose[:d, :d]
        np.testing.assert_allclose(gram, scale**2 * np.eye(d), atol=1e-8)

    def test_status_is_consistent(self, solutions: dict, name: str, model: str) -> None:
        solution = solved(solutions, name, model)
        card = registry.read_card(name)
        if solution.status is Status.OPTIMAL:
            assert card.provides_bounds
            assert solution.certificate_scope
        else:
            ends = (Status.CONVERGED, Status.FAILED)
            assert solution.status in ends or solution.status.is_limit

    def test_bounds_are_consistent(self, solutions: dict, name: str, model: str) -> None:
        solution = solved(solutions, name, model)
        if not registry.read_card(name).provides_bounds:
            assert solution.lower_bound is None
            assert solution.upper_bound is None
            assert solution.trace == []
            return
        slack = 1e-9 * max(1.0, abs(solution.upper_bound))
        assert solution.lower_bound <= solution.upper_bound + slack
        if solution.status is Status.OPTIMAL:
            assert solution.upper_bound - solution.lower_bound <= solution.gap_tol + slack
        assert solution.trace
        for stage in {row.get("stage", "") for row in solution.trace}:
            rows = [row for row in solution.trace if row.get("stage", "") == stage]
            for key, sign in (("lower_bound", 1), ("upper_bound", -1), ("n_nodes", 1)):
                values = np.array([row[key] for row in rows], dtype=float)
                before, after = values[:-1], values[1:]
                assert (sign * after >= sign * before - slack).all(), (stage, key)

    def test_deterministic_methods_repeat_their_results(
        self, solutions: dict, name: str, model: str
    ) -> None:
        first = solved(solutions, name, model)
        if not registry.read_card(name).deterministic or first.status is Status.TIME_LIMIT:
            return
        second = runnable(name).solve(easy_instance(model), LIMITS)
        assert second.status is first.status
        assert second.counters == first.counters
        if first.T_target_source is not None:
            np.testing.assert_array_equal(first.T_target_source, second.T_target_source)

    def test_inputs_are_not_changed(self, solutions: dict, name: str, model: str) -> None:
        solved(solutions, name, model)
        source, target = solutions[name, model, "given"]
        np.testing.assert_array_equal(source, easy_instance(model).source)
        np.testing.assert_array_equal(target, easy_instance(model).target)

    def test_returns_near_its_time_limit(
        self, solutions: dict, name: str, model: str, processor_clock: None
    ) -> None:
        solved(solutions, name, model)  # imports and compilation are done
        instance = easy_instance(model)
        start = time.process_time()
        solution = registry.load(name).solve(instance, Limits(time_s=0.05))
        assert time.process_time() - start < 3.0  # one call of another library cannot be stopped
        finished = solution.status in (Status.CONVERGED, Status.OPTIMAL, Status.FAILED)
        assert finished or solution.status is Status.TIME_LIMIT
        assert solution.T_target_source is not None or solution.status is Status.FAILED

    def test_searches_stop_near_a_limit_on_assignments(
        self, solutions: dict, name: str, model: str
    ) -> None:
        """It stops between two boxes, so it exceeds the limit by those of a box or a start."""
        card, first = registry.read_card(name), solved(solutions, name, model)
        assert card.solves_assignments == ("n_assignments" in first.counters)
        if not card.solves_assignments:
            return
        searches = 2 if model == "rigid3d" else 1
        counts = []
        for limit in (1, 300):
            limits = Limits(time_s=20.0, assignments=limit)
            found = registry.load(name).solve(hard_instance(model), limits)
            assert found.status is not Status.TIME_LIMIT
            assert found.T_target_source is not None
            counts.append(found.counters["n_assignments"])
        assert counts[1] <= counts[0] + searches * 300 + MOST_OF_A_STEP
        if found.status is Status.ASSIGNMENT_LIMIT:
            assert counts[1] >= 300

    def test_awkward_sizes_are_handled(self, name: str, model: str) -> None:
        """Few points, one pair, n != m, coinciding points: a pose or a reason, no exception."""
        method = runnable(name)
        easy = easy_instance(model)
        cases = [
            (easy.source[:5], easy.target[:9], 4),
            (easy.source[:6], easy.target[:4], 1),
            (np.repeat(easy.source[:2], 3, axis=0), easy.target[:7], 3),
        ]
        for source, target, n_inliers in cases:
            instance = Instance(
                "awkward", source, target, easy.model, n_inliers, easy.scale_range, 0.02, 0
            )
            solution = method.solve(instance, Limits(time_s=2.0, nodes=200))
            if solution.T_target_source is None:
                assert solution.status is Status.FAILED
                assert solution.message
            else:
                assert np.isfinite(solution.T_target_source).all()


# Methods that start near the optimum or search globally must solve the easy instance. Feature matches on
# 40 points are unreliable, so correspondence methods have a separate test.
ACCURATE = [
    (name, model) for name, model in PAIRS if not registry.read_card(name).input.startswith("FPFH")
]


@pytest.mark.parametrize(("name", "model"), ACCURATE)
def test_raw_point_methods_solve_the_easy_instance(solutions: dict, name: str, model: str) -> None:
    solution = solved(solutions, name, model)
    if solution.status.is_limit:
        pytest.skip(f"{name} stopped at {solution.status.value}")
    instance = easy_instance(model)
    moved = apply_pose(solution.T_target_source, instance.source)
    distances = np.linalg.norm(moved[:, None] - instance.target[None], axis=2).min(axis=0)
    assert np.sqrt((distances**2).mean()) < 0.05 * rms_radius(instance.target)


def test_the_template_fulfils_the_contract(tmp_path: Path) -> None:
    folder = registry.new_baseline("my_method", root=tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["adapter.py", "card.yaml"]
    assert registry.names(tmp_path) == ["my_method"]
    method = registry.load("my_method", root=tmp_path)
    assert method.available() is None
    assert method.card.display_name == "my_method"
    for model in method.card.models:
        instance = easy_instance(model)
        solution = method.solve(instance, LIMITS)
        assert solution.status is Status.CONVERGED
        moved = apply_pose(solution.T_target_source, instance.source)
        np.testing.assert_allclose(moved.mean(axis=0), instance.target.mean(axis=0), atol=1e-12)
    with pytest.raises(registry.BaselineError, match="exists already"):
        registry.new_baseline("my_method", root=tmp_path)
