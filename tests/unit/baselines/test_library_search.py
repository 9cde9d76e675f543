"""Methods on the library's search: warm-up, messages, refusals."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from baselines import registry
from baselines.contract import Instance, Limits
from baselines.hbsp.rotation import SemidefiniteRotationBound
from dcreg.assignment.objective import objective
from dcreg.driver import checks
from dcreg.driver import modes as table
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.problem import InputError, Problem
from dcreg.search import Boxes, LongestEdge
from workflows import config

# Compiled functions in a process, from the cache or new, before and after a solve.
LOADED = """
import gc
import numpy as np
from numba.core.dispatcher import Dispatcher
from baselines import registry
from baselines.contract import Instance, Limits

def loaded():
    found = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
    return {{(each.py_func.__name__, form) for each in found for form in each.overloads}}

points = np.random.default_rng(0).standard_normal((60, {dim}))
matches = {{"shared-mutual": np.column_stack([np.arange(60)] * 2)}}
instance = Instance("i", points, points + 0.1, "{model}", {k}, {scales}, 0.05, 0, matches=matches)
method = registry.load("dcreg", **{options})
method.warm_up(instance)
warm = loaded()
solution = method.solve(instance, Limits(20.0, nodes=300))
print(solution.message)
print(sorted(name for name, _ in loaded() - warm))
"""


def instance(dim: int, k: int = 6) -> Instance:
    points = np.random.default_rng(3).standard_normal((8, dim))
    model, scales = ("similarity2d", (0.5, 1.5)) if dim == 2 else ("rigid3d", (1.0, 1.0))
    return Instance("i", points, points + 0.1, model, k, scales, 0.05, 0)


@pytest.mark.parametrize(
    ("dim", "k", "options", "ran"),
    [
        (2, 50, {}, "mode paper, bound tight"),
        (3, 50, {}, "mode full, bound rigid"),
        (3, 60, {}, "mode full, bound rigid"),
        (3, 50, {"bound": "dc"}, "mode paper, bound dc"),
        (3, 50, {"front_end": "shared-mutual"}, "mode matches, bound nested"),
    ],
)
def test_a_warm_up_compiles_all_kernels_of_the_solve(dim, k, options, ran):
    model, scales = ("similarity2d", (0.5, 1.5)) if dim == 2 else ("rigid3d", (1.0, 1.0))
    code = LOADED.format(dim=dim, k=k, options=options, model=model, scales=scales)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(registry.__file__).parents[1],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [ran, "[]"]


@pytest.mark.parametrize(
    ("name", "dim", "bound"),
    [
        ("rpm_htb", 2, "mode RPM-HTB (reconstructed), bound termwise"),
        ("rpm_htb", 3, "mode RPM-HTB (reconstructed), bound termwise"),
        ("rpm_bp", 2, "mode RPM-BP (reconstructed), bound rpm-bp"),
        ("hbsp", 2, "mode HBSP (reconstructed), bound hbsp"),
        ("hbsp", 3, "mode HBSP (reconstructed), bound hbsp"),
    ],
)
def test_message_names_mode_and_bound(name, dim, bound):
    solution = registry.load(name, search="ours").solve(instance(dim), Limits(10.0, nodes=20))
    assert solution.message == bound


@pytest.mark.parametrize(
    ("name", "dim"),
    [("dcreg", 2), ("rpm_htb", 2), ("rpm_htb", 3), ("rpm_bp", 2), ("hbsp", 2), ("hbsp", 3)],
)
def test_clouds_too_large_for_a_cost_matrix_are_refused(name, dim, monkeypatch):
    monkeypatch.setattr(checks, "MAX_PAIRS", 60)
    options = {} if name == "dcreg" else {"search": "ours"}
    with pytest.raises(InputError, match="8 x 8 pairs exceed 60"):
        registry.load(name, **options).solve(instance(dim), Limits(10.0))


def test_a_method_with_its_own_bound_searches_all_points(monkeypatch):
    monkeypatch.setattr(table, "LARGE_PAIRS", {2: 60, 3: 60})
    monkeypatch.setattr(table, "LARGE_SAMPLE", {2: 4, 3: 4})
    points = instance(2).source
    problem = Problem(points, points + 0.1, 6, "similarity2d", (0.5, 1.5))
    result = registry.load("rpm_htb", search="ours").result(problem, Limits(10.0, nodes=20))
    assert result.downsampled is None


def test_a_bound_in_our_search_works_alone():
    for name in ("rpm_htb", "rpm_bp"):
        assert registry.load(name, search="ours").mode("similarity2d").make_cover is None


def test_hbsp_bounds_rotations_alike_with_any_threads(rng):
    space = Rotation3D(rng.normal(size=(7, 3)), rng.normal(size=(6, 3)), 5)
    boxes = Boxes.of(space.roots()[:1])
    for _ in range(3):
        boxes = LongestEdge(np.ones(4))(boxes)
    bounds = [SemidefiniteRotationBound(space, threads=threads) for threads in (1, 2)]
    one, two = (bound.evaluate(boxes, np.inf) for bound in bounds)
    np.testing.assert_array_equal(one.lower_bounds, two.lower_bounds)
    np.testing.assert_array_equal(one.values, two.values)
    assert bounds[0].n_assignments == bounds[1].n_assignments


def test_hbsp_bounds_the_objective_about_its_translation_not_the_norms():
    x, y = np.random.default_rng(0).normal(size=(2, 5, 3))
    noise = Instance("i", x, y, "rigid3d", 4, (1.0, 1.0), 0.05, 0)
    for first, options in (("search", {"search": "ours", "polish": False}), ("translation", {})):
        solution = registry.load("hbsp", **options).solve(noise, Limits(30.0, nodes=2000))
        ends = {row["stage"]: row for row in solution.trace if row["kind"] == "end"}
        value, _ = objective(x, y, solution.T_target_source, 4)
        assert solution.upper_bound == pytest.approx(value)
        assert solution.upper_bound == ends["rotation"]["upper_bound"] > ends[first]["upper_bound"]
        assert solution.lower_bound == ends["rotation"]["lower_bound"] != ends[first]["lower_bound"]


def test_hbsp_turns_with_the_threads_it_is_given(monkeypatch):
    seen = []
    made = SemidefiniteRotationBound.__init__

    def spy(self, space, roots=None, threads=1):
        seen.append(threads)
        made(self, space, roots, threads)

    monkeypatch.setattr(SemidefiniteRotationBound, "__init__", spy)
    for search in ("own", "ours"):
        registry.load("hbsp", search=search).solve(instance(3), Limits(10.0, nodes=10, threads=2))
    assert seen == [2, 2]


@pytest.mark.parametrize("experiment", ["all", "demo"])
def test_bounds_are_compared_in_3d_with_dcreg_in_the_same_mode(experiment):
    """The library may otherwise choose a mode with another objective."""
    methods = config.load(experiment).methods
    assert {"mode": "paper", "bound": "tight"} in [method.options for method in methods]
    assert "tight" not in {method.name: method.label for method in methods}["dcreg"]
