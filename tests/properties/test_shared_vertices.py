"""What the bounds over shared vertices pass from box to box: dual variables and the cache."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcreg.families.dc.bounds import VertexCache
from dcreg.families.dc.kernels import Vertices
from dcreg.families.registry import make_bound
from dcreg.families.similarity2d.bound import boxes_of
from dcreg.families.similarity2d.kernels.vertices import blend_duals
from dcreg.search import Box, Budget, LongestEdge, Tolerance, branch_and_bound
from tests.problems import SEEDS, models


@given(SEEDS)
def test_dual_variables_are_the_mean_of_the_neighbours_by_distance(seed):
    generator = np.random.default_rng(seed)
    used, m = 12, 5
    thetas, duals = generator.standard_normal((used, 4)), generator.random((used, m))
    values = np.where(generator.random(used) < 0.5, 1.0, np.inf)
    slots = np.array([generator.permutation(used)[:6] for _ in range(4)])
    slots[0, 5] = -1
    weights, n_fixed = generator.uniform(0.5, 2.0, 4), int(generator.integers(0, used + 1))
    which = np.unique(generator.integers(0, used, 4))
    expected, known = duals.copy(), []
    for slot in which:
        others = [o for box in slots if slot in box for o in box if o not in (-1, slot)]
        others = [o for o in others if values[o] < np.inf or o < n_fixed]
        known.append(bool(others))
        if others:
            distance = (weights * (thetas[others] - thetas[slot]) ** 2).sum(axis=1)
            distance += np.where(np.isinf(values[others]), 1e6, 0.0)
            expected[slot] = np.average(duals[others], axis=0, weights=distance**-3.0)
    # in the search no dual variables that count are being replaced
    independent = not any(values[s] < np.inf or s < n_fixed for s in which)
    vertices = Vertices(thetas, values, values, values, np.empty((used, 0)), duals)
    found = blend_duals(vertices, weights, slots, which, *boxes_of(slots, which), n_fixed)
    assert found.tolist() == known
    first = which[0]
    assert duals[first] == pytest.approx(expected[first])
    if independent:
        assert duals == pytest.approx(expected)


def test_a_full_cache_forgets_the_least_recently_used():
    cache = VertexCache([Box(np.zeros(4), np.ones(4))], 2, 2)
    cache.max_vertices = 60
    halves = [Box(np.zeros(4), np.array([0.5**i, 1.0, 1.0, 1.0])) for i in range(8)]
    for box in halves:
        slots, _ = cache.find(box.lower[None], box.upper[None])
        cache.lows[slots[0]] = box.upper[0]
    assert cache.used <= 60
    last, before = cache.find(halves[-1].lower[None], halves[-1].upper[None])
    assert cache.used == before  # all known
    assert (cache.lows[last[0]] == halves[-1].upper[0]).all()
    assert cache.thetas[last[0]].max(axis=0) == pytest.approx(halves[-1].upper)
    cache.find(halves[1].lower[None], halves[1].upper[None])
    assert cache.used > before  # forgotten, hence new


@given(models(), st.sampled_from(["shared", "tight"]))
def test_a_small_cache_changes_no_certificate(model, name):
    centre, _, _ = model.refine(model.identity + 0.2)
    box = Box(centre - 0.3, centre + 0.3)
    bound = make_bound(name, model, [box])
    bound.cache.max_vertices = 2**9
    branching = LongestEdge(model.axis_weights)
    found, full = (
        branch_and_bound(b, Budget(), branching=branching, tolerance=Tolerance(abs=0.02))
        for b in (bound, make_bound(name, model, [box]))
    )
    assert found.status.value == full.status.value == "optimal"
    assert abs(found.upper_bound - full.upper_bound) <= 0.02 + 1e-9
    assert found.lower_bound <= full.upper_bound + 1e-9
