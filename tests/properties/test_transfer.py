"""A sweep relies on this: the minimum cost per pair does not decrease with the number of pairs."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import dcreg
from dcreg.families.similarity2d.space import Similarity2D
from tests.problems import SEEDS, cloud, model_of, models


def at_every_cardinality(model):
    """The same problem for 1, 2, ... pairs."""
    family = "similarity2d" if isinstance(model, Similarity2D) else "norm3d"
    for k in range(1, min(len(model.source), len(model.target)) + 1):
        yield model_of(family, model.source, model.target, k)


@given(models(), SEEDS)
def test_objective_per_pair_ascends_at_any_pose(model, seed):
    theta = np.random.default_rng(seed).uniform(-1.5, 1.5, model.axis_weights.size)
    values = [other.objective(theta)[0] for other in at_every_cardinality(model)]
    for k, (value, following) in enumerate(itertools.pairwise(values), start=1):
        assert following >= (k + 1) / k * value - 1e-9 * (1.0 + value)


@given(models())
def test_larger_cardinalities_start_from_smaller_boxes(model):
    """So a bound over all poses of the smaller cardinality covers those of the larger one."""
    boxes = [other.roots()[0] for other in at_every_cardinality(model)]
    for wide, narrow in itertools.pairwise(boxes):
        assert (wide.lower <= narrow.lower + 1e-12).all()
        assert (narrow.upper <= wide.upper + 1e-12).all()


@settings(max_examples=20)
@given(SEEDS, st.sampled_from(["general", "noisy copy"]), st.floats(0.01, 0.3))
def test_bounds_of_a_sweep_hold_for_every_pose_tried(seed, kind, noise):
    rng = np.random.default_rng(seed)
    source = cloud(rng, 4, 2, "general")
    target = cloud(rng, 5, 2, "general")
    if kind == "noisy copy":
        target[:4] = source + noise * rng.standard_normal((4, 2))
    found = dcreg.sweep(source, target, range(1, 5), model="similarity2d")
    assert [result.success for result in found.results] == [True] * 4
    per_pair = [result.upper_bound / result.n_inliers for result in found.results]
    assert (np.diff(per_pair) >= -1e-9 * (1.0 + per_pair[-1])).all()
    for taken, asked in itertools.product(found.results, repeat=2):
        value, _ = dcreg.objective(source, target, taken.T_target_source, asked.n_inliers)
        assert value >= asked.lower_bound - 1e-9
        assert value >= asked.upper_bound - asked.gap_tol - 1e-9


@settings(max_examples=20)
@given(SEEDS)
def test_poses_are_tried_for_fewer_pairs_also_where_no_search_ended(seed):
    rng = np.random.default_rng(seed)
    source, target = cloud(rng, 7, 2, "general"), cloud(rng, 7, 2, "general")
    counts = [2, 3, 5, 6]
    found = dcreg.sweep(
        source, target, counts, model="similarity2d", rel_gap=0.0, abs_gap=0.0, node_limit=1
    )
    per_pair = [result.upper_bound / result.n_inliers for result in found.results]
    assert (np.diff(per_pair) >= -1e-9 * (1.0 + per_pair[-1])).all()
    bounds = [result.lower_bound / result.n_inliers for result in found.results]
    assert (np.diff(bounds) >= -1e-9).all()
