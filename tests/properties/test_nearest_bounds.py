"""Go-ICP, FRS and GoTS: bounds hold in their cubes and converge to the objective."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from baselines._shared.closest_point import ClosestPoint, spread_poses
from baselines._shared.consensus import Consensus
from baselines._shared.cubes import OCTANTS, Incumbent, OutOfTimeError, search_cubes
from baselines._shared.poses import homogeneous
from baselines._shared.rotation_search import most_correspondences, most_matches
from baselines.contract import Instance
from baselines.frs import search as frs
from baselines.goicp import kernels
from baselines.goicp.adapter import Frame, optimal_translations
from baselines.goicp.distance import Cells
from baselines.goicp.search import GoICP, Settings, uncertainty
from baselines.gots import search as gots
from dcreg.problem import apply_pose
from dcreg.search import Budget
from dcreg.status import Status
from tests.problems import SEEDS

WIDTHS = st.sampled_from([np.pi, 0.8, 0.2, 0.03, 0.0])


def never() -> Budget:
    return Budget(60.0)


def clouds(
    seed: int, n: int = 9, m: int = 11
) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    """A cloud and a moved, noisy, partly replaced copy in another order."""
    generator = np.random.default_rng(seed)
    source = generator.uniform(-0.5, 0.5, (n, 3))
    rotation = Rotation.random(random_state=generator).as_matrix()
    shared = source[: n - 2] @ rotation.T + generator.uniform(-0.3, 0.3, 3)
    target = np.vstack([shared, generator.uniform(-0.5, 0.5, (m - n + 2, 3))])
    target += 0.01 * generator.standard_normal(target.shape)
    return generator, source, generator.permutation(target)


def settings_for(n_kept: int, half: float = 0.4) -> Settings:
    return Settings(
        n_kept=n_kept, tolerance=1e-3 * n_kept, translation_centre=np.zeros(3),
        translation_half_width=half, cells_per_axis=8, icp_tolerance=0.0, n_starts=1, seed=0,
    )  # fmt: skip


def pose_of(rotation_vector: np.ndarray, t: np.ndarray) -> np.ndarray:
    return homogeneous(1.0, Rotation.from_rotvec(rotation_vector).as_matrix(), t)


def trimmed(source: np.ndarray, target: np.ndarray, pose: np.ndarray, n_kept: int) -> float:
    distances = np.linalg.norm(apply_pose(pose, source)[:, None] - target, axis=2).min(axis=1)
    return float((np.sort(distances)[:n_kept] ** 2).sum())


class TestDistance:
    @given(SEEDS, st.integers(1, 60), st.sampled_from([4, 8, 13, 24]))
    def test_is_the_exact_one_inside_and_outside_of_the_cells(self, seed, m, per_axis):
        generator = np.random.default_rng(seed)
        target = generator.standard_normal((m, 3)) * generator.uniform(0.0, 2.0, 3)
        points = 3.0 * generator.standard_normal((300, 3))
        expected, _ = cKDTree(target).query(points)
        found = Cells(target, reach=2.0, per_axis=per_axis).distances(points)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


class TestGoICP:
    @given(SEEDS, WIDTHS)
    def test_uncertainty_covers_the_rotations_of_a_cube(self, seed, half):
        generator, source, _ = clouds(seed)
        centre = generator.uniform(-2, 2, 3)
        at_centre = Rotation.from_rotvec(centre).apply(source)
        gamma = uncertainty(half, np.linalg.norm(source, axis=1))
        for offset in [*OCTANTS, *generator.uniform(-1, 1, (20, 3))]:
            moved = Rotation.from_rotvec(centre + half * offset).apply(source)
            assert (np.linalg.norm(moved - at_centre, axis=1) <= gamma + 1e-12).all()

    @given(SEEDS, WIDTHS, st.sampled_from([0.4, 0.1, 0.01, 0.0]), st.integers(1, 9))
    def test_bound_of_a_pair_of_cubes_holds_in_them(self, seed, half, width, n_kept):
        generator, source, target = clouds(seed)
        centre, t = generator.uniform(-2, 2, 3), generator.uniform(-0.3, 0.3, 3)
        gamma = uncertainty(half, np.linalg.norm(source, axis=1))
        points = Rotation.from_rotvec(centre).apply(source)
        cells = Cells(target, 2.0, 8).arrays
        scratch, dropped = np.empty(len(source)), np.empty(len(source))
        found = kernels.cube_values(
            points, gamma, np.sqrt(3) * width, t, n_kept, cells, np.inf, scratch, dropped
        )
        bound, relaxed, true = found
        for offset, shift in generator.uniform(-1, 1, (20, 2, 3)):
            pose = pose_of(centre + half * offset, t + width * shift)
            assert bound <= trimmed(source, target, pose, n_kept) + 1e-12
            pose[:3, 3] = t
            assert relaxed <= trimmed(source, target, pose, n_kept) + 1e-12
        at_centre = trimmed(source, target, pose_of(centre, t), n_kept)
        assert true == pytest.approx(at_centre, abs=1e-12)
        assert bound <= relaxed <= true + 1e-15
        if half == width == 0.0:
            assert bound == pytest.approx(true, abs=1e-12)
        cutoff = 0.5 * bound
        early, *rest = kernels.cube_values(
            points, gamma, np.sqrt(3) * width, t, n_kept, cells, cutoff, scratch, dropped
        )
        assert cutoff <= early <= bound + 1e-15
        assert rest == [np.inf, np.inf] or early == bound

    @given(SEEDS, st.sampled_from([0.5, 0.1, 0.01]), st.sampled_from([5, 9]))
    def test_bound_of_a_rotation_cube_holds_for_all_translations(self, seed, half, n_kept):
        generator, source, target = clouds(seed)
        problem = GoICP(source, target, settings_for(n_kept), never())
        centre = generator.uniform(-2, 2, 3)
        bound, _ = problem.bound_cube(centre, half)
        for offset, shift in generator.uniform(-1, 1, (20, 2, 3)):
            pose = pose_of(centre + half * offset, 0.4 * shift)
            assert bound <= trimmed(source, target, pose, n_kept) + 1e-12
        reached = trimmed(source, target, problem.incumbent.pose, n_kept)
        assert problem.incumbent.value == pytest.approx(reached, abs=1e-12)

    @given(SEEDS, st.integers(2, 9))
    def test_translations_that_can_be_optimal_are_searched(self, seed, n_kept):
        """The fit to any k partners of any k points, hence the optimum, lies in the cube."""
        generator, source, target = clouds(seed)
        centre, half = optimal_translations(source, target, n_kept)
        for _ in range(20):
            rows = generator.permutation(len(source))[:n_kept]
            partners = target[generator.integers(0, len(target), n_kept)]
            rotation = Rotation.random(random_state=generator).as_matrix()
            t = partners.mean(axis=0) - rotation @ source[rows].mean(axis=0)
            assert (np.abs(t - centre) <= half).all()

    def test_identical_clouds_cost_nothing(self):
        _, source, _ = clouds(3)
        outcome = GoICP(source, source.copy(), settings_for(9), never()).run()
        assert outcome.status is Status.OPTIMAL
        assert outcome.upper_bound == 0.0

    @given(SEEDS)
    def test_frame_and_back_is_the_same_pose(self, seed):
        generator, source, target = clouds(seed)
        instance = Instance(
            "f", 7.0 * source + 3.0, 7.0 * target - 5.0, "rigid3d", 5, (1, 1), 0.1, seed
        )
        frame = Frame(instance, normalise=True)
        assert max(np.abs(frame.source).max(), np.abs(frame.target).max()) == pytest.approx(1.0)
        rotation = Rotation.random(random_state=generator).as_matrix()
        pose = homogeneous(1.0, rotation, generator.uniform(-1, 1, 3))
        inside = trimmed(frame.source, frame.target, pose, 5) * frame.unit**2
        outside = trimmed(instance.source, instance.target, frame.restore(pose), 5)
        assert inside == pytest.approx(outside, rel=1e-9)


class TestRotationSearch:
    @pytest.mark.parametrize("search", [most_matches, most_correspondences])
    @given(SEEDS, st.sampled_from([0.02, 0.1, 0.3]), st.integers(0, 6), st.integers(0, 2))
    def test_bounds_the_count_of_every_rotation(self, search, seed, radius, cutoff, slack):
        in_pairs = search is most_correspondences
        generator, source, target = clouds(seed, 9, 9 if in_pairs else 11)
        found = search(source, target, radius, cutoff, slack, never())

        def count(rotation: np.ndarray, within: float) -> int:
            distances = np.linalg.norm((source @ rotation.T)[:, None] - target, axis=2)
            nearest = np.diag(distances) if in_pairs else distances.min(axis=1)
            return int((nearest <= within).sum())

        assert found.count <= count(found.rotation, radius + 1e-9)
        assert found.upper_bound <= max(cutoff, found.count + slack)
        most = found.upper_bound if in_pairs else max(found.upper_bound, cutoff)
        for rotation in Rotation.random(200, random_state=generator).as_matrix():
            assert count(rotation, radius - 1e-9) <= most

    @given(SEEDS)
    def test_planted_points_are_all_found(self, seed):
        generator, source, _ = clouds(seed)
        rotation = Rotation.random(random_state=generator).as_matrix()
        found = most_matches(source, source @ rotation.T, 0.01, 0, 0, never())
        assert found.count == found.upper_bound == len(source)

    def test_points_in_the_origin_match_under_any_rotation(self):
        source = np.array([[0.0, 0, 0], [0.4, 0, 0]])
        target = np.array([[0.05, 0, 0], [0, 0.4, 0]])
        found = most_matches(source, target, 0.1, 0, 0, never())
        assert found.count == found.upper_bound == 2


class TestFRS:
    @given(SEEDS, st.sampled_from([0.3, 0.1, 0.02]))
    def test_bound_of_a_cube_holds_in_it_and_shrinks_with_it(self, seed, half):
        generator, source, target = clouds(seed)
        instance = Instance("p", source, target, "rigid3d", 7, (1, 1), 0.05, 0)
        problem = Consensus(instance, 0.05)
        incumbent = Incumbent(-problem.count(np.eye(4)), np.eye(4))
        cubes = frs.TranslationCubes(problem, incumbent, 0, never())
        local = ClosestPoint(problem.source, problem.target, problem.n_inliers)
        fitted = max(local.descend(spread_poses(8, 0, np.zeros(3)), 0.0)[0], key=problem.count)
        count = problem.count(fitted)
        centre = fitted[:3, 3] + half * generator.uniform(-1, 1, 3)  # a cube that matters
        bound, _ = cubes.bound(centre, half)
        assert bound <= -count
        assert -len(source) <= bound
        for shift in generator.uniform(-1, 1, (5, 3)):
            pose = fitted.copy()
            pose[:3, 3] = centre + half * shift
            assert bound <= -problem.count(pose)
        child, _ = cubes.bound(centre + half / 2 * OCTANTS[0], half / 2)
        # the incumbent may lie elsewhere, and counts below its own are not bounded more closely
        assert child >= min(bound, incumbent.value)
        assert incumbent.value == -problem.count(incumbent.pose)

    @given(SEEDS)
    def test_every_matching_translation_is_searched(self, seed):
        generator, source, target = clouds(seed)
        centre, half = frs.matching_translations(source, target, 0.05)
        for _ in range(20):
            i, j = generator.integers(len(source)), generator.integers(len(target))
            turned = Rotation.random(random_state=generator).apply(source[i])
            t = target[j] - turned + 0.05 * generator.uniform(-1, 1, 3) / np.sqrt(3)
            assert (np.abs(t - centre) <= half).all()


def pair_count(source: np.ndarray, target: np.ndarray, t: np.ndarray, eps: float) -> int:
    """Source pairs with a target pair of like features, by the definition."""
    a, b = np.linalg.norm(source + t, axis=1), np.linalg.norm(target, axis=1)
    near = np.abs(a[:, None] - b) <= eps
    lengths = np.linalg.norm(target[:, None] - target, axis=2)
    matched = 0
    for i in range(len(source)):
        for k in range(i + 1, len(source)):
            same = np.abs(lengths - np.linalg.norm(source[i] - source[k])) <= 2 * eps
            both = near[i][:, None] & near[k][None, :] & same
            np.fill_diagonal(both, False)
            matched += bool(both.any())
    return matched


class TestGoTS:
    @given(SEEDS, st.sampled_from([0.5, 0.1, 0.02]), st.sampled_from([0.01, 0.05]))
    def test_bound_of_a_cube_holds_in_it_and_shrinks_with_it(self, seed, half, eps):
        generator, source, target = clouds(seed)
        cubes = gots.TranslationCubes(source, target, eps, Incumbent(0.0, np.zeros(3)), never())
        centre = generator.uniform(-0.5, 0.5, 3)
        upper = -cubes.bound(centre, half, cubes.all_pairs)[0]
        kept, _ = cubes._matched(cubes.all_pairs, centre, half, -1)
        assert len(kept) == upper or upper <= -cubes.incumbent.value
        for shift in generator.uniform(-1, 1, (10, 3)):
            count = pair_count(source, target, centre + half * shift, eps)
            assert count <= max(upper, -cubes.incumbent.value)
            assert cubes.count(centre + half * shift) == count
        smaller, _ = cubes._matched(kept, centre + half / 2 * OCTANTS[3], half / 2, -1)
        assert set(smaller) <= set(kept)

    @given(SEEDS)
    def test_matched_points_make_matched_pairs(self, seed):
        """c one-to-one matches at a pose are c (c - 1) / 2 pairs at its translation."""
        generator, source, _ = clouds(seed)
        rotation = Rotation.random(random_state=generator).as_matrix()
        t, eps = generator.uniform(-0.5, 0.5, 3), 0.03
        noise = generator.standard_normal(source.shape)
        noise *= eps * generator.uniform(0, 1, (9, 1)) / np.linalg.norm(noise, axis=1)[:, None]
        target = (source + t) @ rotation.T + noise
        cubes = gots.TranslationCubes(source, target, eps, Incumbent(), never())
        assert cubes.count(t) == 36
        assert gots.points_of(36) == 9
        centre, half = gots.matching_translations(source, target, eps)
        assert (np.abs(t - centre) <= half).all()

    def test_full_overlap_without_noise_recovers_the_translation(self):
        _, source, _ = clouds(5)
        t = np.array([0.3, -0.2, 0.1])
        target = (source + t) @ Rotation.from_rotvec([1, 2, 3]).as_matrix().T
        eps, incumbent = 0.004, Incumbent(0.0, np.zeros(3))
        cubes = gots.TranslationCubes(source, target, eps, incumbent, never())
        found = search_cubes(
            cubes.bound, gots.matching_translations(source, target, eps), incumbent, Budget(60.0),
            gap_tol=0.0, floor=-36.0, passed_on=cubes.all_pairs,
        )  # fmt: skip
        assert found.status is Status.OPTIMAL
        assert incumbent.value == -36
        np.testing.assert_allclose(incumbent.pose, t, atol=10 * eps)


class TestCubes:
    @given(SEEDS)
    def test_minimises_a_cone_to_its_tolerance(self, seed):
        generator = np.random.default_rng(seed)
        peak = generator.uniform(-1, 1, 3)
        incumbent = Incumbent()

        def bound(centre, half, passed_on):
            distance = float(np.linalg.norm(centre - peak))
            incumbent.offer(distance, centre)
            return max(distance - np.sqrt(3) * half, 0.0), None

        found = search_cubes(bound, (np.zeros(3), 1.0), incumbent, Budget(60.0), gap_tol=0.01)
        assert found.status is Status.OPTIMAL
        assert incumbent.value == found.upper_bound
        assert found.upper_bound - found.lower_bound <= 0.01
        assert found.lower_bound <= 1e-12

    @pytest.mark.parametrize(
        ("budget", "status"),
        [
            (lambda: Budget(60.0, nodes=20), Status.NODE_LIMIT),
            (lambda: Budget(60.0, memory_mb=0), Status.MEMORY_LIMIT),
            (lambda: Budget(0.0), Status.TIME_LIMIT),
        ],
    )
    def test_stops_at_limits_with_a_valid_bound(self, budget, status):
        found = search_cubes(
            lambda centre, half, passed_on: (0.5 - half / 10, None), (np.zeros(3), 1.0),
            Incumbent(1.0, None), budget(), gap_tol=1e-6,
        )  # fmt: skip
        assert found.status is status
        assert 0.0 <= found.lower_bound <= 0.5
        assert found.events[-1].kind == "end"

    def test_a_bound_out_of_time_leaves_its_cubes_the_bound_of_their_parent(self):
        budget, asked = Budget(0.5), []

        def bound(centre, half, passed_on):
            asked.append(half)
            if len(asked) == 4:
                while not budget.is_over:
                    time.sleep(0.01)
                raise OutOfTimeError
            return -7.0 if half == 1.0 else -6.0, None

        found = search_cubes(
            bound, (np.zeros(3), 1.0), Incumbent(0.0), budget, gap_tol=0.0, floor=-9.0
        )
        assert found.status is Status.TIME_LIMIT
        assert (found.lower_bound, found.upper_bound) == (-7.0, 0.0)
        assert asked == [1.0, 0.5, 0.5, 0.5]

    @pytest.mark.parametrize("memory_mb", [None, 0.02])
    def test_children_receive_the_results_of_their_cube_while_memory_suffices(self, memory_mb):
        everything, fulls = np.zeros(1000), []

        def bound(centre, half, passed_on):
            fulls.append(passed_on is everything)
            if passed_on is not everything:  # then it comes from the cube's own parent
                assert (np.abs(centre - passed_on[:3]) < passed_on[3]).all()
            return 0.5 - half, np.array([*centre, half, *np.zeros(996)])

        search_cubes(
            bound, (np.zeros(3), 1.0), Incumbent(1.0), Budget(60.0, 200, memory_mb),
            gap_tol=0.0, passed_on=everything,
        )  # fmt: skip
        # the root has no parent; with memory for one result, only the first child receives it
        assert fulls.count(True) == 1 if memory_mb is None else fulls.count(True) > 100
