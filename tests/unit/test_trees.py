"""The search tree of a cloud is built once, never belongs to other points, and finds the nearest ones."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcreg.problem.trees import Tree, tree_of


def test_a_tree_is_built_once_for_equal_points(rng):
    points = rng.standard_normal((100, 3))
    tree = tree_of(points)
    assert tree_of(points.copy()) is tree
    assert Tree(points) is not tree


def test_changed_points_get_a_new_tree(rng):
    points = rng.standard_normal((100, 3))
    before = tree_of(points)
    points += 10.0
    distances, _ = tree_of(points).nearest(points)
    assert tree_of(points) is not before
    assert (distances == 0.0).all()


def test_the_trees_of_two_clouds_stay_and_a_third_displaces_the_older(rng):
    clouds = rng.standard_normal((3, 50, 2))
    first, second = map(tree_of, clouds[:2])
    assert tree_of(clouds[0]) is first
    tree_of(clouds[2])
    assert tree_of(clouds[0]) is first
    assert tree_of(clouds[1]) is not second


@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 200),
    dim=st.sampled_from([2, 3]),
    decimals=st.sampled_from([0, 1, 12]),  # coarse coordinates: many equal points and distances
    offset=st.sampled_from([0.0, 1e6]),
)
def test_neighbours_are_the_nearest_points(seed, n, dim, decimals, offset):
    rng = np.random.default_rng(seed)
    points = np.round(rng.standard_normal((n, dim)), decimals) + offset
    some = np.round(2.0 * rng.standard_normal((20, dim)), decimals) + offset
    count = min(n, int(rng.integers(1, 12)))
    distances, rows = Tree(points).neighbours(some, count)
    apart = np.linalg.norm(some[:, None] - points, axis=2)
    np.testing.assert_allclose(distances, np.sort(apart, axis=1)[:, :count], rtol=1e-12)
    np.testing.assert_allclose(np.take_along_axis(apart, rows, axis=1), distances, rtol=1e-12)
    assert all(len(set(row)) == count for row in rows)
    np.testing.assert_array_equal(Tree(points).nearest(some)[0], distances[:, 0])


def test_missing_neighbours_are_infinitely_far(rng):
    distances, rows = Tree(np.array([[0.0, 0.0], [3.0, 0.0]])).neighbours(
        np.array([[0.5, 0.0]]), 2, reach=1.0
    )
    assert distances.tolist() == [[0.5, np.inf]]
    assert rows.tolist() == [[0, 2]]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes do not fork on this system")
def test_a_forked_process_finds_neighbours():
    """OpenMP would wait for the threads of the parent."""
    code = """
import os, numpy as np
from dcreg.problem.trees import Tree
points = np.random.default_rng(0).standard_normal((50_000, 3))
tree = Tree(points)
tree.nearest(points)
child = os.fork()
if not child:
    os._exit(int(tree.nearest(points)[0].max()))
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
