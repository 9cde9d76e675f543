"""Our correspondence methods on planted pairs, and their parts."""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from baselines import registry
from baselines._shared import cliques
from baselines._shared.cliques import maximum_clique, pack
from baselines._shared.consistency import vote, vote_scale
from baselines._shared.kernels.graphs import degeneracy
from baselines._shared.kernels.lengths import consistency_graph
from baselines._shared.ransac import ransac
from baselines._shared.robust import gnc_pose
from baselines.clipper.dense import dense_clique
from baselines.contract import Instance, Limits
from baselines.gore import adapter as gore
from baselines.mac.adapter import compatibility
from baselines.mac.enumerate import HeaviestCliques
from baselines.sc2_pcr_pp.adapter import candidate_closeness
from baselines.turboreg.adapter import ordered_scores
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget
from dcreg.status import Status
from tests.correspondences import NOISE, planted, rows_as_pairs

METHODS = [
    *("teaser", "gnc_tls", "clipper", "sc2_pcr", "sc2_pcr_pp", "turboreg", "mac", "gore", "ransac"),
]
BOTH = [name for name in METHODS if "similarity2d" in registry.read_card(name).models]


def rms_to(pose: np.ndarray, truth: np.ndarray, points: np.ndarray) -> float:
    apart = apply_pose(pose, points) - apply_pose(truth, points)
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


CASES = [
    *((name, "rigid3d", 0.5 if name == "gnc_tls" else 0.9) for name in METHODS),
    *((name, "similarity2d", 0.4) for name in BOTH),
]


@pytest.mark.parametrize(("name", "model", "outliers"), CASES)
def test_planted_pose_is_recovered_despite_outliers(name: str, model: str, outliers: float) -> None:
    instance, truth = planted(model, 300, outliers)
    found = registry.load(name).estimate(instance, rows_as_pairs(300), Budget(120.0))
    assert found.finished
    assert rms_to(found.pose, truth, instance.source) < NOISE


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_result_does_not_depend_on_the_unit_of_length(name: str, unit: float) -> None:
    method = registry.load(name)
    first, second = (
        method.estimate(instance, rows_as_pairs(120), Budget(20.0)).pose
        for instance, _ in (planted("rigid3d", 120, 0.5), planted("rigid3d", 120, 0.5, unit))
    )
    np.testing.assert_allclose(second[:3, :3], first[:3, :3], atol=1e-6)
    np.testing.assert_allclose(second[:3, 3] / unit, first[:3, 3], atol=1e-6)


@pytest.mark.parametrize("name", METHODS)
def test_hopeless_pairs_end_in_time_with_a_true_status(name: str, processor_clock: None) -> None:
    """All pairs of random clouds, with a wide bound that makes the graphs dense."""
    generator = np.random.default_rng(0)
    source, target = generator.random((2, 35, 3))
    instance = Instance("random", source, target, "rigid3d", 20, (1, 1), 0.12, 0)
    method = registry.load(name, front_end="all-pairs", max_pairs=1000)
    method.warm_up(instance)
    start = time.process_time()
    solution = method.solve(instance, Limits(0.3))
    assert time.process_time() - start < 4 * 0.3  # limit and one step
    assert solution.status in (Status.TIME_LIMIT, Status.CONVERGED, Status.FAILED)
    assert solution.T_target_source is not None or solution.status is Status.FAILED
    assert "28 of 35 source points paired" in solution.message
    if name == "teaser":
        assert solution.extra["clique_upper_bound"] >= solution.extra["clique_size"]
        proven = solution.extra["clique_upper_bound"] == solution.extra["clique_size"]
        assert proven or solution.status is Status.TIME_LIMIT


class Clock(Budget):
    """A budget that is over after a number of checks."""

    def __init__(self, looks: int) -> None:
        super().__init__()
        self.looks = looks

    @property
    def is_over(self) -> bool:
        self.looks -= 1
        return self.looks < 0


def random_graph(generator: np.random.Generator, n: int, density: float) -> np.ndarray:
    upper = np.triu(generator.random((n, n)) < density, 1)
    return upper | upper.T


def assert_is_clique(vertices: np.ndarray, adjacency: np.ndarray) -> None:
    inside = adjacency[np.ix_(vertices, vertices)]
    assert inside.sum() == len(vertices) * (len(vertices) - 1)


class TestCliques:
    def graph_of(self, seed: int) -> np.ndarray:
        generator = np.random.default_rng(seed)
        n, density = generator.integers(1, 90), generator.choice([0.1, 0.3, 0.5, 0.7])
        return random_graph(generator, n, density)

    @pytest.mark.parametrize("seed", range(40))
    def test_maximum_is_that_of_networkx(self, seed: int) -> None:
        adjacency = self.graph_of(seed)
        clique = maximum_clique(pack(adjacency), Budget())
        expected, _ = nx.max_weight_clique(nx.from_numpy_array(adjacency), weight=None)
        assert clique.is_maximum
        assert len(clique.vertices) == len(expected)
        assert_is_clique(clique.vertices, adjacency)

    @pytest.mark.parametrize("seed", range(10))
    def test_core_numbers_are_those_of_networkx(self, seed: int) -> None:
        adjacency = self.graph_of(seed)
        order, core = degeneracy(pack(adjacency))
        expected = nx.core_number(nx.from_numpy_array(adjacency))
        assert [expected[i] for i in range(len(adjacency))] == list(core)
        assert sorted(order) == list(range(len(adjacency)))

    def test_of_several_the_first_in_degeneracy_order_where_none_was_grown(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(cliques, "STARTS", 0)  # as if all grown ones were too small
        for seed in range(15):
            adjacency = self.graph_of(seed)
            rows = pack(adjacency)
            place = np.argsort(degeneracy(rows)[0])
            listed = list(nx.find_cliques(nx.from_numpy_array(adjacency)))
            size = max(map(len, listed))
            first = min(sorted(place[clique]) for clique in listed if len(clique) == size)
            assert sorted(place[maximum_clique(rows, Budget()).vertices]) == first

    def test_cut_off_search_gives_a_clique_and_a_bound(self) -> None:
        adjacency = random_graph(np.random.default_rng(1), 300, 0.9)
        clique = maximum_clique(pack(adjacency), Budget(0.1))
        assert not clique.is_maximum
        assert len(clique.vertices) < clique.upper_bound < 300
        assert_is_clique(clique.vertices, adjacency)

    def test_steps_cut_by_the_time_limit_are_reported(self) -> None:
        """Also if only the choice among maximum cliques remains."""
        rows = pack(random_graph(np.random.default_rng(3), 60, 0.5))
        whole = maximum_clique(rows, Budget())
        assert not whole.is_cut
        cut = [maximum_clique(rows, Clock(looks)) for looks in range(400)]
        assert all((c.vertices == whole.vertices).all() for c in cut if not c.is_cut)
        assert any(c.is_maximum and c.is_cut for c in cut)
        assert not cut[-1].is_cut

    def test_no_vertices_no_clique(self) -> None:
        clique = maximum_clique(np.zeros((0, 1), dtype=np.uint64), Budget())
        assert len(clique.vertices) == clique.upper_bound == 0


def test_heaviest_clique_through_every_vertex_is_that_of_a_full_list() -> None:
    generator = np.random.default_rng(4)
    upper = np.triu(generator.random((40, 40)) * (generator.random((40, 40)) < 0.4), 1)
    weights = upper + upper.T
    search = HeaviestCliques(pack(weights > 0), weights, generator.permutation(40), 10_000)
    assert search.run(Budget())
    listed = [c for c in nx.find_cliques(nx.from_numpy_array(weights > 0)) if len(c) >= 3]
    assert search.n_cliques == len(listed)
    for vertex in range(40):
        sums = [weights[np.ix_(c, c)].sum() / 2 for c in listed if vertex in c]
        assert search.heaviest[vertex] == pytest.approx(max(sums, default=-np.inf))


def test_cap_on_maximal_cliques_is_reported() -> None:
    instance, _ = planted("rigid3d", 150, 0.3)
    noisy = replace(instance, noise_bound=0.15)
    found = registry.load("mac", max_cliques=3).estimate(noisy, rows_as_pairs(150), Budget(20.0))
    assert "starts capped at 3" in found.message


def test_mac_agrees_in_lengths_by_noise_bounds_or_as_published() -> None:
    """On a line: lengths that differ by 1 and by 1.5, and two pairs that share a point."""
    source = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [2.0, 0, 0]])
    target = np.array([[0.0, 0, 0], [2.0, 0, 0], [0.5, 0, 0], [2.5, 0, 0]])
    pairs = np.array([[0, 0], [1, 1], [2, 2], [2, 3]])
    own = compatibility(source, target, pairs, 1.2, None, 0.99)
    assert own[0, 1] == pytest.approx(1 - (1 / 1.2) ** 2)
    assert own[0, 2] == own[2, 3] == own[0, 0] == 0.0
    # median spacing of the target: 0.5
    published = compatibility(source, target, pairs, 1.2, 10.0, 0.97)
    assert published[0, 1] == pytest.approx(np.exp(-1 / (2 * 5.0**2)))
    assert published[0, 2] == 0.0  # exp(-0.045) = 0.956


@pytest.mark.parametrize("name", ["sc2_pcr", "sc2_pcr_pp"])
@pytest.mark.parametrize(("factor", "n_pairs"), [(0.9, 8), (1.1, 4)])
def test_lengths_of_sc2_pcr_may_differ_by_the_inlier_distance(
    name: str, factor: float, n_pairs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of a target moved as a whole: lengths across differ by at most that."""
    graphs = []

    def watched(*arguments: object) -> np.ndarray:
        graphs.append(consistency_graph(*arguments))
        return graphs[-1]

    solver = registry.load(name)
    monkeypatch.setattr(sys.modules[type(solver).__module__], "consistency_graph", watched)
    source = np.zeros((8, 3))
    source[:, 0] = np.repeat([0.0, 1.0], 4)
    source[:, 1:] = np.tile([[0, 0], [0.01, 0], [0, 0.01], [0.01, 0.01]], (2, 1))
    target = source + np.where(source[:, :1] > 0.5, [[factor * NOISE, 0, 0]], 0.0)
    instance = Instance("halves", source, target, "rigid3d", 8, (1, 1), NOISE, 5)
    solver.estimate(instance, rows_as_pairs(8), Budget(time_s=10.0))
    degrees = np.unpackbits(graphs[0].view(np.uint8), axis=1).sum(axis=1)
    assert (degrees == n_pairs - 1).all()


def test_vote_minimises_the_truncated_cost() -> None:
    generator = np.random.default_rng(2)
    for _ in range(20):
        values = np.concatenate([generator.normal(3, 0.05, 10), generator.uniform(0, 9, 25)])
        ranges = generator.uniform(0.05, 0.3, len(values))
        best, voters = vote(values, ranges)
        grid = np.concatenate([np.linspace(-1, 10, 20001), [best]])
        cost = np.minimum(((values - grid[:, None]) / ranges) ** 2, 1).sum(axis=1)
        assert cost[-1] <= cost.min() + 1e-9
        np.testing.assert_array_equal(voters, np.abs(values - best) <= ranges)


def test_voted_scale_is_within_its_range() -> None:
    instance, _ = planted("similarity2d", 100, 0.5)
    free, limited = (
        vote_scale(instance.source, instance.target, 2 * NOISE, scale_range)
        for scale_range in ((0.5, 1.5), (0.9, 1.5))
    )
    assert free == pytest.approx(0.7, abs=0.02)
    assert limited >= 0.9


def test_a_source_point_is_as_close_as_its_nearest_candidate() -> None:
    source = np.zeros((5, 3))
    target = np.zeros((5, 3))
    target[:, 0] = [0.05, 0.0, 0.3, 0.1, 5.0]
    points = np.array([0, 0, 0, 2, 3])  # of bound 0.2: point 0 is met, 2 half-way, 3 not at all
    assert candidate_closeness(np.eye(4), source, target, points, 0.2) == pytest.approx(1.5)


def test_no_further_pose_is_refined_past_the_time_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    budget = Budget(listener=lambda _: True)
    refined = []

    def late(pose: np.ndarray, *_: object) -> np.ndarray:
        refined.append(pose)
        budget.report_incumbent(0.0)  # whose listener stops the run
        return pose

    monkeypatch.setattr("baselines.sc2_pcr_pp.adapter.refine", late)
    instance, _ = planted("rigid3d", 60, 0.5)
    found = registry.load("sc2_pcr_pp").estimate(instance, rows_as_pairs(60), budget)
    assert found.pose is not None
    assert not found.finished
    assert len(refined) == 1


def test_pairs_that_share_a_point_are_never_both_taken() -> None:
    points = np.random.default_rng(0).random((6, 3))
    pairs = np.array([[0, 0], [1, 1], [1, 2], [3, 2]])
    rows = consistency_graph(points[:4], points[:4], pairs, 10.0, 1.0)
    joined = np.unpackbits(rows.view(np.uint8), axis=1, bitorder="little")[:, :4]
    np.testing.assert_array_equal(joined, [[0, 1, 1, 1], [1, 0, 0, 1], [1, 0, 0, 0], [1, 1, 0, 0]])
    scores = ordered_scores(points[:4], points[:4], pairs, 10.0)
    np.testing.assert_array_equal(scores, [[0, 1, 0, 1], [0, 0, 0, 1], [0] * 4, [0] * 4])


def test_gnc_without_outliers_is_least_squares() -> None:
    instance, _ = planted("rigid3d", 50, 0.0)
    clouds = instance.source, instance.target
    pose, weights, finished = gnc_pose(*clouds, NOISE, (1.0, 1.0), Budget())
    assert finished
    assert (weights == 1).all()
    expected = fit_pose(*clouds, (1.0, 1.0))
    np.testing.assert_allclose(pose, expected, atol=1e-12)


def test_dense_clique_of_two_blocks_is_the_denser() -> None:
    consistent = np.zeros((20, 20), dtype=bool)
    consistent[:12, :12] = consistent[12:, 12:] = True
    affinity = np.where(consistent, 1.0, 0.0)
    chosen, finished = dense_clique(affinity, consistent, Budget())
    assert finished
    assert list(chosen) == list(range(12))


def test_ransac_ends_early_when_sure_and_repeats_itself() -> None:
    instance, _ = planted("rigid3d", 100, 0.1)
    settings = {"seed": 1, "max_samples": 50_000, "confidence": 0.999, "budget": Budget()}
    first, second = (
        ransac(instance.source, instance.target, NOISE, (1.0, 1.0), **settings) for _ in range(2)
    )
    assert first[1] < 2000
    np.testing.assert_array_equal(first[0], second[0])


def test_gore_samples_only_what_its_removal_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pose by RANSAC precedes the removal, as in the published method."""
    kept: list[int] = []
    remove, sample = gore.remove_outliers, gore.ransac

    def removing(*arguments, **settings):
        removal = remove(*arguments, **settings)
        kept.append(len(removal.kept))
        return removal

    def sampling(source, *arguments, **settings):
        kept.append(len(source))
        return sample(source, *arguments, **settings)

    monkeypatch.setattr(gore, "remove_outliers", removing)
    monkeypatch.setattr(gore, "ransac", sampling)
    instance, _ = planted("rigid3d", 60, 0.5)
    registry.load("gore").estimate(instance, rows_as_pairs(60), Budget(20.0))
    assert len(kept) == 2
    assert kept[0] == kept[1] < 60
