"""Attacks on proofs of symmetric and of almost planar shapes; those on others are edits of a file."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcreg.certificate import format
from dcreg.certificate.verification import objective_of, verify
from tests.problems import register

LEAVES = ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")
SIXTH = np.exp(1j * np.pi / 3)


@cache
def hexagon():
    """A regular hexagon and a noisy copy: six poses are optimal."""
    corners = SIXTH ** np.arange(6)
    source = np.column_stack([corners.real, corners.imag])
    target = source + 0.1 * np.random.default_rng(0).standard_normal((6, 2)) + 2.0
    result = register(
        source, target, n_inliers=6, model="similarity2d", rel_gap=0.1, certificate=True
    )
    assert result.status == "optimal"
    return result.certificate, source, target


def turned(theta, steps):
    """The pose turned by 60 degrees as often as given."""
    factor = complex(*theta[:2]) * SIXTH**steps
    return np.array([factor.real, factor.imag, *theta[2:]])


def around(c, theta):
    """Which leaves contain a pose."""
    return ((c.leaf_lower <= theta + 1e-9) & (theta - 1e-9 <= c.leaf_upper)).all(axis=1)


def test_a_symmetric_shape_is_proven_with_any_of_its_poses():
    """A certificate states the value of the optimum, not that its pose is the only one."""
    certificate, source, target = hexagon()
    statements = set()
    for steps in range(1, 6):
        pose = dataclasses.replace(certificate, theta=turned(certificate.theta, steps))
        report = verify(pose, source, target)
        assert report.accepted, report.reason
        statements.add(report.statement)
    assert len(statements) == 1


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("steps", [1, 3])
def test_no_pose_of_a_symmetric_shape_can_be_left_out(exact, steps):
    """As if the pose of the certificate were the only one: neither removed nor closed early."""
    certificate, source, target = hexagon()
    leaves = around(certificate, turned(certificate.theta, steps))
    assert leaves.any()
    hidden = {
        "leaf_reasons": np.where(leaves, format.INADMISSIBLE, certificate.leaf_reasons),
        "leaf_bounds": np.where(leaves, np.inf, certificate.leaf_bounds),
    }
    raised = np.where(leaves, 1.1 * certificate.upper_bound, certificate.leaf_bounds)
    removed = {name: getattr(certificate, name)[~leaves] for name in LEAVES}
    for edit in removed, hidden, {"leaf_bounds": raised}:
        forged = dataclasses.replace(certificate, **edit)
        assert not verify(forged, source, target, exact=exact, n_samples=0).accepted


@cache
def sheet(thickness):
    """An almost planar cloud and its mirror image, which no rotation reaches."""
    source = np.random.default_rng(3).standard_normal((8, 3)) * [1.0, 0.7, thickness]
    target = (source * [1.0, 1.0, -1.0]) @ Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix().T
    result = register(source, target, n_inliers=8, model="rigid3d", certificate=True, prove=True)
    assert result.status == "optimal"
    return result.certificate, source, target


@pytest.mark.parametrize("thickness", [0.1, 1e-3, 1e-5])
def test_a_mirror_image_of_a_sheet_is_no_exact_fit(thickness):
    certificate, source, target = sheet(thickness)
    report = verify(certificate, source, target)
    assert report.accepted, report.reason
    assert not report.is_trivial
    assert 0.0 < report.lower_bound <= report.upper_bound < 10.0 * thickness**2
    free = {"upper_bound": 0.0, "lower_bound": 0.0, "leaf_bounds": 0.0 * certificate.leaf_bounds}
    forged = dataclasses.replace(certificate, **free)
    assert "upper_bound: 0 stated" in verify(forged, source, target).reason


@pytest.mark.parametrize("thickness", [0.1, 1e-3, 1e-5])
def test_a_worse_pose_of_a_sheet_is_not_proven_optimal(thickness):
    """Turned in the plane, with bounds to match: only the proof can find what is false."""
    certificate, source, target = sheet(thickness)
    objective = objective_of(certificate, source, target)
    theta = certificate.theta + 0.3 * thickness * np.array([0.0, 1.0, -1.0, 0.5, 0, 0, 0])
    worse = objective.value(theta)
    bound = 0.5 * (worse + certificate.upper_bound)
    forged = dataclasses.replace(
        certificate, theta=theta, upper_bound=worse, lower_bound=bound, gap_tol=worse - bound,
        leaf_bounds=np.full(len(certificate.leaf_bounds), bound),
    )  # fmt: skip
    assert worse > 1.1 * certificate.upper_bound
    assert not verify(forged, source, target, n_samples=0).accepted
