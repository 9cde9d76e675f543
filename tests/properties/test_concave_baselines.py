"""RPM-CAV and RPM-PA: bounds are below the objective, and no wrong optimum is certified."""

from __future__ import annotations

import os
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from baselines import registry
from baselines._shared.concave import Clouds, Incumbent, Reduced, Support
from baselines._shared.kernels.statistics import concave, minimum_linear, statistics
from baselines.contract import Instance, Limits
from baselines.rpm_cav.box import BoxBound
from baselines.rpm_cav.kernels import bound_simplex, values_at
from baselines.rpm_cav.search import root_simplex
from baselines.rpm_pa.kernels import value_at
from baselines.rpm_pa.polytope import Polytope
from baselines.rpm_pa.search import Search
from dcreg import objective
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import Space
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget
from dcreg.status import Status
from tests.oracles.matchings import matchings, optimal_similarity
from tests.problems import KINDS, SEEDS, cloud
from tests.searches import is_certified
from workflows.records import RAW_TRACES

SCALES = (0.5, 1.5)


@cache
def columns_of(n: int, m: int, k: int) -> np.ndarray:
    """All one-to-one matchings of k pairs, as (count, n) columns with -1 for unmatched rows."""
    found = []
    for rows, columns in matchings(n, m, k):
        found.append(np.full(n, -1))
        found[-1][rows] = columns
    return np.array(found)


def every_matching(instance: Instance) -> np.ndarray:
    return columns_of(len(instance.source), len(instance.target), instance.n_inliers)


def clouds_of(instance: Instance) -> Clouds:
    source, target = np.ascontiguousarray(instance.source), np.ascontiguousarray(instance.target)
    return Clouds(source, target, instance.n_inliers, *instance.scale_range)


def least_squares(instance: Instance, col_of: np.ndarray) -> float:
    """E(P): residual of the best admissible pose for one matching."""
    rows = np.flatnonzero(col_of >= 0)
    x, y = instance.source[rows], instance.target[col_of[rows]]
    pose = fit_pose(x, y, instance.scale_range)
    return float(((x @ pose[:2, :2].T + pose[:2, 2] - y) ** 2).sum())


def problem(seed: int, most: int = 5) -> Instance:
    """A random small problem of random kind: noisy copies, duplicates, ties, pure noise."""
    generator = np.random.default_rng(seed)
    n, m = generator.integers(3, most, 2, endpoint=True)
    k = int(generator.integers(2, min(n, m), endpoint=True))
    kind = KINDS[generator.integers(len(KINDS))]
    source, target = cloud(generator, n, 2, kind), cloud(generator, m, 2, kind)
    if kind == "noisy copy":
        angle, scale = generator.uniform(0, 2 * np.pi), generator.uniform(*SCALES)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        noise = generator.choice([0.0, 0.05, 0.3]) * generator.standard_normal((k, 2))
        target[:k] = scale * source[:k] @ turn.T + noise + generator.uniform(-1, 1, 2)
    return Instance(f"small-{seed}", source, target, "similarity2d", k, SCALES, 0.05, seed)


def support_of(clouds: Clouds, with_fixed: bool = False) -> Support:
    return Support(Incumbent(clouds, Budget(), -np.inf), with_fixed)


def shares_of(simplex: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Barycentric coordinates, a column per place."""
    system = np.vstack([simplex.T, np.ones(len(simplex))])
    return np.linalg.solve(system, np.vstack([places.T, np.ones(len(places))]))


class TestReduction:
    @given(SEEDS)
    def test_value_of_a_matching_is_its_least_squares_residual(self, seed: int) -> None:
        instance = problem(seed)
        generator = np.random.default_rng(seed)
        for col_of in generator.choice(every_matching(instance), 5):
            u, fixed = statistics(clouds_of(instance), col_of)
            value = fixed + concave(clouds_of(instance), u)
            assert value == pytest.approx(least_squares(instance, col_of), abs=1e-9)

    @given(SEEDS)
    def test_function_is_concave_also_where_no_matching_is(self, seed: int) -> None:
        generator = np.random.default_rng(seed)
        clouds = clouds_of(problem(seed))
        a, b = generator.normal(0.0, 10.0, (2, 7))
        share = generator.uniform()
        between = concave(clouds, share * a + (1 - share) * b)
        chord = share * concave(clouds, a) + (1 - share) * concave(clouds, b)
        assert between >= chord - 1e-9 * (1 + abs(chord))

    @given(SEEDS)
    def test_linear_functions_attain_their_minimum_at_the_assignment(self, seed: int) -> None:
        instance = problem(seed)
        clouds = clouds_of(instance)
        weights = np.random.default_rng(seed).standard_normal(8)
        value, col_of = minimum_linear(clouds, weights[:7], weights[7])
        every = [col_of, *every_matching(instance)]
        points = np.array([np.append(*statistics(clouds, each)) for each in every])
        values = points @ weights
        assert value == pytest.approx(values.min(), abs=1e-9)
        assert value == pytest.approx(values[0], abs=1e-9)

    @given(SEEDS, st.booleans())
    def test_coordinates_and_root_simplex_reach_every_matching(
        self, seed: int, with_fixed: bool
    ) -> None:
        instance = problem(seed)
        clouds = clouds_of(instance)
        support = support_of(clouds, with_fixed)
        z = support.coordinates()
        root = None if with_fixed or z.dim == 0 else root_simplex(support, z)
        for col_of in every_matching(instance):
            u, fixed = statistics(clouds, col_of)
            point = np.append(u, fixed) if with_fixed else u
            place = z.inverse @ (point - z.origin)
            assert (place > -1e-7).all()
            assert (place < 1 + 1e-7).all()
            np.testing.assert_allclose(z.origin + z.axes @ place, point, atol=1e-6)
            if root is not None:
                assert (shares_of(root, place[None]) > -1e-7).all()


class TestSimplexBound:
    @given(SEEDS, st.integers(0, 6))
    def test_below_the_objective_of_every_matching_inside(self, seed: int, ascents: int) -> None:
        instance = problem(seed, most=4)
        clouds, generator = clouds_of(instance), np.random.default_rng(seed)
        z = support_of(clouds).coordinates()
        if z.dim == 0:
            return
        every = every_matching(instance)
        values = np.array([least_squares(instance, col_of) for col_of in every])
        u = np.array([statistics(clouds, col_of)[0] for col_of in every])
        places = (u - z.origin) @ z.inverse.T
        size = generator.choice([3.0, 0.5, 0.05])
        simplex = generator.choice(places) + size * generator.standard_normal((z.dim + 1, z.dim))
        simplex[0] += (places[0] - simplex.mean(axis=0)) * (z.dim + 1)  # one matching is inside
        at_vertices = values_at(clouds, z.origin, z.axes, simplex)
        col_of = np.empty(len(clouds.source), np.int64)
        cutoff = float(generator.choice([values.min(), values.max() + 10.0]))
        bound, best, _ = bound_simplex(
            clouds, z.origin, z.inverse, simplex, at_vertices, cutoff, ascents, col_of
        )
        inside = (shares_of(simplex, places) >= 0).all(axis=0)
        inside[0] = True
        slack = 1e-7 * (1 + np.abs(at_vertices).max())
        assert bound <= values[inside].min() + slack
        assert best == pytest.approx(least_squares(instance, col_of), abs=1e-8)


def value_at_theta(instance: Instance, theta: np.ndarray) -> float:
    a, b, tx, ty = theta
    pose = np.array([[a, -b, tx], [b, a, ty], [0, 0, 1]])
    return objective(instance.source, instance.target, pose, instance.n_inliers)[0]


@given(SEEDS, st.sampled_from([1.0, 0.1, 0.001, 0.0]))
def test_box_bound_is_below_the_objective_and_exact_at_a_point(seed: int, size: float) -> None:
    instance = problem(seed)
    generator = np.random.default_rng(seed)
    centre = generator.uniform(-1.5, 1.5, 4)
    half = size * generator.uniform(0, 1, 4)
    bound = BoxBound(instance)(centre - half, centre + half)
    for theta in generator.uniform(centre - half, centre + half, (30, 4)):
        value = value_at_theta(instance, theta)
        assert bound <= value + 1e-8 * (1 + value)
    if size == 0.0:
        assert bound == pytest.approx(value, abs=1e-7)


class TestPolytope:
    @given(SEEDS, st.integers(1, 5))
    def test_cones_cover_the_space(self, seed: int, dim: int) -> None:
        generator = np.random.default_rng(seed)
        polytope = Polytope(np.vstack([np.eye(dim), -np.ones(dim)]), 0.0)
        for _ in range(12):
            polytope.annex(generator.standard_normal(dim) * generator.uniform(0.5, 3.0))
        alive = np.flatnonzero(np.isfinite(polytope.bounds[: polytope.n_slots]))
        assert len(alive) == polytope.n_facets
        vertices = polytope.vertices[polytope.members[alive]]
        for direction in generator.standard_normal((20, dim)):
            shares = np.linalg.solve(vertices.swapaxes(1, 2), direction[:, None])[..., 0]
            assert (shares.min(axis=1) > -1e-9).any()
        passed = polytope.vertices @ polytope.normals[alive].T
        assert passed.max() <= 1 + 1e-6  # convex: no vertex passes a facet

    @settings(max_examples=30)
    @given(SEEDS, st.sampled_from([0.0, 0.3]))
    def test_bound_of_a_cone_is_below_its_matchings(self, seed: int, epsilon0: float) -> None:
        instance = problem(seed, most=4)
        reduced = Reduced.of(instance, Budget(nodes=100), 1.0)
        search = Search(reduced, 0.01, epsilon0)
        kept: list[Polytope] = []
        rebuild = search._rebuilt
        search._rebuilt = lambda: kept.append(rebuild()) or kept[-1]  # type: ignore[method-assign]
        search.run()
        if not kept:
            return
        polytope, z = kept[-1], search.z
        alive = np.flatnonzero(np.isfinite(polytope.bounds[: polytope.n_slots]))
        vertices = polytope.vertices[polytope.members[alive]]
        for col_of in every_matching(instance):
            point = np.append(*statistics(reduced.clouds, col_of))
            place = z.inverse @ (point - z.origin)
            value = value_at(reduced.clouds, z.origin, z.axes, place)
            shares = np.linalg.solve(vertices.swapaxes(1, 2), (place - search.inner)[:, None])
            # every matching is in some cone whose bound holds for it
            holding = alive[shares[..., 0].min(axis=1) > -1e-9]
            assert holding.size
            # a target without extent gives a frame of huge numbers
            slack = 1e-9 * (1 + np.abs(z.origin).max() + np.abs(z.axes).max())
            assert polytope.bounds[holding].min() <= value + slack


# The whole thousand: SMALL_PROBLEMS=1000 python -m pytest -k wrong_optimum
N_PROBLEMS = int(os.environ.get("SMALL_PROBLEMS", "40"))
METHODS = [
    ("rpm_cav", {}),
    ("rpm_cav", {"ascents": 4}),
    ("rpm_cav", {"branching": "longest"}),
    ("rpm_pa", {"epsilon0": 0.3}),
    ("rpm_pa", {"epsilon0": 0.0}),
    ("rpm_pa", {"epsilon0": 0.0, "local_search": False}),
]


@pytest.mark.parametrize(("name", "options"), METHODS)
def test_never_certifies_a_wrong_optimum(name: str, options: dict) -> None:
    n_optimal = 0
    for seed in range(N_PROBLEMS):
        instance = problem(seed)
        points = instance.source, instance.target
        factor = (0.03, 0.1, 0.3)[seed % 3]
        method = registry.load(name, epsilon_factor=factor, **options)
        solution = method.solve(instance, Limits(time_s=20.0, nodes=20_000))
        optimum = optimal_similarity(*points, instance.n_inliers, SCALES)
        n_optimal += is_certified(solution, optimum, solution.gap_tol)
        # the upper bound is E(P) of a matching, and its pose is the fit to it
        value, _ = objective(*points, solution.T_target_source, instance.n_inliers)
        assert value <= solution.upper_bound + 1e-8, seed
        values = [least_squares(instance, col_of) for col_of in every_matching(instance)]
        assert np.abs(np.array(values) - solution.upper_bound).min() < 1e-8, seed
    print(f"{name} {options}: {n_optimal} of {N_PROBLEMS} certified")
    assert n_optimal > 0.3 * N_PROBLEMS


def test_a_local_search_takes_no_step_after_the_time_limit() -> None:
    points = np.random.default_rng(0).standard_normal((8, 2))
    clouds = Clouds(points, points[::-1], 6, *SCALES)
    spent = []
    for time_s in (60.0, 0.0):
        incumbent = Incumbent(clouds, Budget(time_s), alternates=True)
        assert incumbent.offer(np.array([0, 1, 2, 3, 4, 5, -1, -1]))
        spent.append(incumbent.n_assignments)
    assert spent[0] > spent[1] == 0


@pytest.mark.parametrize(
    ("name", "options"), [("rpm_cav", {}), ("rpm_pa", {"local_search": False})]
)
def test_incumbents_are_the_matchings_of_the_search(name: str, options: dict, monkeypatch) -> None:
    """None comes from the library's search or from a local search."""
    for space in (Space, FeatureSpace, Similarity2D):
        for method in {"start", "starts", "seeds", "score", "refine"} & vars(space).keys():
            monkeypatch.setattr(space, method, None)
    monkeypatch.setattr("dcreg.assignment.descent.polish", None)
    offered, offer = [], Incumbent.offer

    def recorded(self: Incumbent, col_of: np.ndarray) -> bool:
        offered.append(least_squares(instance, col_of))
        return offer(self, col_of)

    monkeypatch.setattr(Incumbent, "offer", recorded)
    source, target = np.random.default_rng(4).standard_normal((2, 9, 2))
    instance = Instance("noise", source, target, "similarity2d", 6, SCALES, 0.05, 0)
    solution = registry.load(name, **options).solve(instance, Limits(60.0, nodes=300))
    assert len(offered) > 1
    assert solution.upper_bound == pytest.approx(min(offered))
    bounds = {row["upper_bound"] for row in solution.trace}
    assert all(np.abs(np.array(offered) - bound).min() < 1e-8 for bound in bounds)


@pytest.mark.parametrize("name", ["rpm_cav", "rpm_pa"])
@pytest.mark.parametrize(
    ("limits", "status"),
    [
        (Limits(60.0, nodes=50), Status.NODE_LIMIT),
        (Limits(60.0, memory_mb=0), Status.MEMORY_LIMIT),
        (Limits(0.0), Status.TIME_LIMIT),
    ],
)
def test_limits_end_the_search_with_a_pose_a_bound_and_a_history(
    name: str, limits: Limits, status: Status
) -> None:
    source, target = np.random.default_rng(4).standard_normal((2, 9, 2))
    instance = Instance("noise", source, target, "similarity2d", 6, SCALES, 0.05, 0)
    solution = registry.load(name).solve(instance, limits)
    assert solution.status is status
    value, _ = objective(source, target, solution.T_target_source, 6)
    assert 0.0 <= solution.lower_bound <= value <= solution.upper_bound + 1e-9
    assert RAW_TRACES.keys() - {"run_id", "instance_id"} <= solution.trace[0].keys()
    *before, last = solution.trace
    assert {row["kind"] for row in before} == {"bound"}
    assert (last["kind"], last["status"]) == ("end", status)
    assert last["lower_bound"] == solution.lower_bound
