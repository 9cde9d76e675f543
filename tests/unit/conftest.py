"""Shared fixtures of the tests of the command line."""

import numpy as np
import pytest


@pytest.fixture
def cloud_files(tmp_path):
    """A 2D pair with a known pose: 12 points, rotated by 0.4 rad, scaled by 1.2, translated."""
    source = np.random.default_rng(3).random((12, 2))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    target = 1.2 * source @ turn.T + [5.0, -2.0]
    np.savetxt(tmp_path / "source.txt", source)
    np.savez(tmp_path / "target.npz", a=target, b=target[:6])
    return tmp_path / "source.txt", f"{tmp_path / 'target.npz'}:a"


@pytest.fixture
def call(cloud_files):
    """The arguments of a good call; others are appended."""
    return ["register", *cloud_files, "--model", "similarity2d", "--n-inliers", "0.8"]


@pytest.fixture
def sweep_call(cloud_files):
    return ["sweep", *cloud_files, "--model", "similarity2d", "--n-inliers", "6:12:3"]
