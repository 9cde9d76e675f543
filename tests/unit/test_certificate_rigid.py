"""Certificates of rigid poses in 3D: true ones are accepted, edited ones refused."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

import dcreg
from dcreg.certificate import format, read, write
from dcreg.certificate.rigid import RigidPoses
from dcreg.certificate.rigid_proof import RigidProof
from dcreg.certificate.verification import objective_of, verify
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.status import Status
from tests.certificates import rigid_case
from tests.problems import register
from tests.unit.test_cli import run

LEAVES = ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")


@pytest.fixture(scope="module", params=[0, 2], ids=["all match", "outliers"])
def case(request):
    certificate, source, target = rigid_case(request.param)
    assert certificate.status == "optimal"
    assert certificate.lower_bound > 0
    return certificate, source, target


# --- true certificates ------------------------------------------------------------------------


def test_file_of_a_proof_is_accepted(case, tmp_path):
    certificate, source, target = case
    write(tmp_path / "c.npz", certificate)
    assert read(tmp_path / "c.npz").model == "rigid3d"
    report = verify(tmp_path / "c.npz", source, target)
    assert report.accepted, report.reason
    area = certificate.unit**2
    assert report.upper_bound == certificate.upper_bound * area
    assert report.lower_bound == certificate.lower_bound * area
    assert report.lower_bound == pytest.approx(report.upper_bound - report.gap_tol)
    assert report.statement.startswith("over all rigid poses: ")
    assert not report.is_trivial
    assert len(report.checks) == 8


@pytest.mark.parametrize(
    "options",
    [{"node_limit": 300}, {"start_box": "radius"}, {"rel_gap": 0.2}, {"max_rms": 0.01}],
    ids=str,
)
def test_other_searches_are_accepted(options):
    certificate, source, target = rigid_case(2, **options)
    report = verify(certificate, source, target)
    assert report.accepted, report.reason
    if "node_limit" in options:
        assert certificate.status == "node_limit"
        assert (certificate.leaf_reasons == format.OPEN).any()


@pytest.mark.parametrize("extra", [0, 2])
def test_candidates_are_part_of_the_statement(extra):
    _, source, target = rigid_case(extra)
    allowed = np.random.default_rng(3).random((len(source), len(target))) < 0.6
    allowed[np.arange(8), np.arange(8)] = True
    result = register(
        source, target, n_inliers=8, model="rigid3d", candidates=allowed, certificate=True
    )
    assert result.mode == "full"
    assert result.status is Status.OPTIMAL
    report = dcreg.verify(result.certificate, source, target)
    assert report.accepted, report.reason
    assert f"among {allowed.sum()} candidates" in report.statement


def test_exact_fit_is_accepted(rng):
    source = rng.standard_normal((9, 3))
    target = source[::-1] + 4.0
    result = register(source, target, n_inliers=9, model="rigid3d", certificate=True)
    assert result.status is Status.OPTIMAL
    assert dcreg.verify(result.certificate, source, target).accepted


def test_the_command_writes_and_verifies_a_certificate(tmp_path):
    for name, points in zip("ab", rigid_case()[1:], strict=True):
        np.savetxt(tmp_path / f"{name}.txt", points)
    points = tmp_path / "a.txt", tmp_path / "b.txt"
    asked = ["--model", "rigid3d", "--n-inliers", "8", "--certificate", tmp_path / "c.npz"]
    for mode in ("full", "paper", "auto"):
        found = run("register", *points, *asked, "--mode", mode)
        assert found.exit_code == 0, found.output
        proven = run("verify", tmp_path / "c.npz", *points)
        assert proven.exit_code == 0, proven.output
        assert ("over all rigid poses" in proven.output) == (mode != "paper")


def test_points_far_smaller_than_the_target_are_proven():
    """Wide boxes of rotations need caps, even if the points hardly move."""
    target = np.random.default_rng(0).standard_normal((40, 3))
    result = register(
        np.ones((40, 3)), target, n_inliers=40, model="rigid3d", mode="full", certificate=True
    )
    report = dcreg.verify(result.certificate, np.ones((40, 3)), target)
    assert report.accepted, report.reason
    assert report.n_boxes < 100
    assert report.n_assignments < 50  # not one for each sampled pose


@pytest.fixture(scope="module")
def with_duals():
    """More than 1,000 pairs of points: a search bounds fewer by caps, without duals."""
    rng = np.random.default_rng(4)
    source = rng.standard_normal((36, 3)) * [1.0, 0.7, 0.4]
    target = np.vstack([source[4:], rng.standard_normal((2, 3))]) + 0.02 * rng.standard_normal(
        (34, 3)
    )
    result = register(
        source, target, n_inliers=32, model="rigid3d", certificate=True, prove=True, rel_gap=0.3
    )
    assert result.status is Status.OPTIMAL
    assert result.certificate.leaf_duals.max() == 15
    return result.certificate, source, target


@pytest.mark.parametrize("change", ["none", "random", "largest"])
def test_poor_duals_take_boxes_but_not_the_proof(with_duals, change):
    """The duals of a file are hints, which a forger can choose."""
    certificate, source, target = with_duals
    shape = certificate.leaf_duals.shape
    assert shape == (len(certificate.leaf_bounds), len(source))
    rng, units = np.random.default_rng(0), certificate.dual_units
    duals = {
        "none": np.empty((0, 0)), "random": rng.integers(16, size=shape), "largest": np.full(shape, 15),
    }[change]  # fmt: skip
    poor = dataclasses.replace(certificate, leaf_duals=duals, dual_units=units[: len(duals)])
    best, report = (verify(each, source, target) for each in (certificate, poor))
    assert report.accepted, report.reason
    assert report.lower_bound == best.lower_bound
    assert report.n_boxes > best.n_boxes
    false = dataclasses.replace(
        poor, theta=_worse(poor, source, target), status="stopped",
        **{name: 1.5 * getattr(poor, name) for name in BOUNDS},
    )  # fmt: skip
    refused = verify(false, source, target, n_samples=0, max_boxes=len(false.leaf_bounds))
    assert "could not be confirmed" in refused.reason or "is false" in refused.reason


BOUNDS = "lower_bound", "upper_bound", "gap_tol", "leaf_bounds"


def _worse(certificate, source, target):
    """A pose whose objective is 1.5 times the best one."""
    objective, step = objective_of(certificate, source, target), np.zeros(7)
    low, high = 0.0, 1.0
    for _ in range(60):
        step[4] = 0.5 * (low + high)
        value = objective.value(certificate.theta + step)
        low, high = (step[4], high) if value < 1.5 * certificate.upper_bound else (low, step[4])
    return certificate.theta + step


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c: {"leaf_duals": c.leaf_duals[:, 1:]}, "leaf_duals: of 35 points"),
        (lambda c: {"leaf_duals": c.leaf_duals[1:]}, "dual_units: shape"),
        (
            lambda c: {"leaf_duals": c.leaf_duals[1:], "dual_units": c.dual_units[1:]},
            "leaf_duals: of",
        ),
        (lambda c: {"leaf_duals": c.leaf_duals[:, 0]}, "leaf_duals: shape"),
        (lambda c: {"leaf_duals": np.uint8(0)}, "leaf_duals: shape"),
        (lambda c: {"scale_range": [1.0, 1e9]}, "scale_range: "),
        (lambda c: {"dual_units": np.full_like(c.dual_units, 60)}, "larger than any"),
        (lambda c: {"dual_units": np.full_like(c.dual_units, 127)}, "larger than any"),
    ],
)
def test_duals_that_do_not_fit_are_refused(with_duals, change, reason):
    certificate, source, target = with_duals
    report = verify(dataclasses.replace(certificate, **change(certificate)), source, target)
    assert not report.accepted
    assert reason in report.reason


def test_the_size_of_duals_is_compared_by_leaf(with_duals):
    """The largest unit and the largest number may belong to different leaves."""
    certificate, source, target = with_duals
    duals, units = certificate.leaf_duals.copy(), certificate.dual_units.copy()
    duals[0], units[0] = 0, 60
    changed = dataclasses.replace(certificate, leaf_duals=duals, dual_units=units)
    assert verify(changed, source, target).accepted


def test_the_check_needs_numpy_only(with_duals, tmp_path):
    certificate, source, target = with_duals
    write(tmp_path / "c.npz", certificate)
    np.savez(tmp_path / "clouds.npz", source=source, target=target)
    code = """
import sys
for name in "scipy", "numba":
    sys.modules[name] = None
import numpy as np
from dcreg.certificate.verification import verify
clouds = np.load("clouds.npz")
report = verify("c.npz", clouds["source"], clouds["target"])
assert report.accepted, report.reason
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)


def test_a_file_without_duals_is_read(case, tmp_path):
    """Version 4 of the format had none."""
    certificate, source, target = case
    write(tmp_path / "c.npz", certificate)
    with np.load(tmp_path / "c.npz") as file:
        arrays = dict(file)
    for name in "leaf_duals", "dual_units", "checksum":
        del arrays[name]
    arrays["format_version"] = np.array(4)
    arrays["checksum"] = np.array(format._checksum(arrays))
    np.savez(tmp_path / "old.npz", **arrays)
    report = verify(tmp_path / "old.npz", source, target)
    assert report.accepted, report.reason


def test_a_range_of_poses_has_no_certificate():
    _, source, target = rigid_case()
    near = dcreg.PoseRange(max_angle=10.0)
    with pytest.raises(
        dcreg.InputError, match="certificate: `dcreg verify` does not support ranges"
    ):
        register(source, target, n_inliers=8, model="rigid3d", pose_range=near, certificate=True)


def test_start_box_contains_the_region_of_the_check():
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n, m = sorted(rng.integers(1, 9, 2))
        x, y = rng.standard_normal((n, 3)) ** 3, rng.standard_normal((m, 3))
        k = int(rng.integers(1, n + 1))
        lower, upper = RigidPoses(x, y, k, (1.0, 1.0)).region()
        for stationary in (True, False):
            box = Rigid3D(x, y, k, stationary_box=stationary).translations()
            assert (box.lower <= lower[4:] + 1e-9).all()
            assert (box.upper >= upper[4:] - 1e-9).all()


# --- edited certificates ----------------------------------------------------------------------


def some(c, rows):
    return {name: getattr(c, name)[rows] for name in LEAVES}


def with_row(c, name, row, value):
    entries = getattr(c, name).copy()
    entries[row] = value
    return {name: entries}


def moved_to(c, leaf, axis):
    """The leaf with its facet changed."""
    lower, upper = c.leaf_lower.copy(), c.leaf_upper.copy()
    own = int(np.flatnonzero(lower[leaf, :4] == upper[leaf, :4])[0])
    for ends in (lower, upper):
        ends[leaf, [own, axis if axis != own else (axis + 1) % 4]] = ends[
            leaf, [axis if axis != own else (axis + 1) % 4, own]
        ]
    return {"leaf_lower": lower, "leaf_upper": upper}


def widest(c):
    """A leaf and an axis along which its box is wide, and does not reach the end of the start box."""
    inner = np.where(c.leaf_upper < c.start_upper - 1e-3, c.leaf_upper - c.leaf_lower, 0.0)
    return np.unravel_index(np.argmax(inner), inner.shape)


def grown(c, change):
    leaf, axis = widest(c)
    width = (c.leaf_upper - c.leaf_lower)[leaf, axis]
    return with_row(c, "leaf_upper", (leaf, axis), c.leaf_upper[leaf, axis] + change * width)


def other_pose(c, share):
    """A worse pose that is claimed to be the optimum, with bounds to match."""
    value = c.objective.value(theta := c.theta + np.array([0.0, 0.02, -0.02, 0.01, 0, 0, 0]))
    bound = c.upper_bound + share * (value - c.upper_bound)
    return {
        "theta": theta, "upper_bound": value, "lower_bound": bound, "gap_tol": value - bound,
        "leaf_bounds": np.full(len(c.leaf_bounds), bound),
    }  # fmt: skip


EDITS = {
    "lower bound above the upper": lambda c: {"lower_bound": 1.01 * c.upper_bound},
    "lower bound above the leaves": lambda c: {"lower_bound": 0.5 * (c.lower_bound + c.upper_bound)},
    "negative lower bound": lambda c: {"lower_bound": -1.0},
    "all bounds raised": lambda c: {"leaf_bounds": c.leaf_bounds + 1.0},
    "one bound raised": lambda c: with_row(c, "leaf_bounds", 3, 2.0 * c.upper_bound),
    "one bound lowered": lambda c: with_row(c, "leaf_bounds", 3, 0.5 * c.lower_bound),
    "another pose as the optimum": lambda c: other_pose(c, 0.5),
    "another pose, nearly true": lambda c: other_pose(c, 0.1),
    "leaf removed": lambda c: some(c, np.arange(1, len(c.leaf_bounds))),
    "last leaf removed": lambda c: some(c, np.arange(len(c.leaf_bounds) - 1)),
    "facet removed": lambda c: some(c, c.leaf_lower[:, 2] != 1.0),
    "leaf duplicated": lambda c: some(c, np.append(np.arange(len(c.leaf_bounds)), 5)),
    "leaf shrunk": lambda c: grown(c, -0.1),
    "leaf grown": lambda c: grown(c, 0.1),
    "leaf on another facet": lambda c: moved_to(c, 4, 1),
    "leaf replaced by its neighbour": lambda c: some(
        c, np.where(np.arange(len(c.leaf_bounds)) == 4, 5, np.arange(len(c.leaf_bounds)))
    ),
    "leaf on no facet": lambda c: with_row(c, "leaf_lower", (4, slice(4)), -1.0),
    "leaf turned inside out": lambda c: {"leaf_lower": c.leaf_upper, "leaf_upper": c.leaf_lower},
    "smaller start box": lambda c: {
        "start_lower": c.start_lower * 0.9, "start_upper": c.start_upper * 0.9,
        "leaf_lower": c.leaf_lower * 0.9, "leaf_upper": c.leaf_upper * 0.9,
    },
    "start box moved": lambda c: {
        name: getattr(c, name) + np.append(np.zeros(4), np.full(3, 0.1))
        for name in ("start_lower", "start_upper", "leaf_lower", "leaf_upper")
    },
    "half of the quaternions": lambda c: {
        "start_lower": np.append(np.zeros(4), c.start_lower[4:])
    },
    "more quaternions": lambda c: {"start_upper": np.append(2 * np.ones(4), c.start_upper[4:])},
    "identity as the pose": lambda c: {"theta": np.array([1.0, 0, 0, 0, 0, 0, 0])},
    "pose rotated": lambda c: {"theta": c.theta + np.array([0, 1e-3, 0, 0, 0, 0, 0])},
    "pose shifted": lambda c: {"theta": c.theta + np.array([0, 0, 0, 0, 1e-3, 0, 0])},
    "pose mirrored": lambda c: {"theta": c.theta * np.array([1, -1, -1, -1, 1, 1, 1])},
    "no quaternion": lambda c: {"theta": np.append(np.zeros(4), c.theta[4:])},
    "upper bound lowered": lambda c: {"upper_bound": 0.999 * c.upper_bound},
    "upper bound raised": lambda c: {"upper_bound": 1.001 * c.upper_bound},
    "one pair less": lambda c: {"n_inliers": c.n_inliers - 1},
    "one pair more": lambda c: {"n_inliers": c.n_inliers + 1},
    "smaller tolerance": lambda c: {"gap_tol": 0.1 * c.gap_tol},
    "leaves called empty": lambda c: {
        "leaf_reasons": np.full(len(c.leaf_bounds), format.INADMISSIBLE),
    },
    "unknown reason": lambda c: with_row(c, "leaf_reasons", 0, 9),
    "another unit": lambda c: {"unit": 1.001 * c.unit},
    "another centre": lambda c: {"source_centre": c.source_centre + 1e-3},
    "another model": lambda c: {"model": "translation3d"},
    "unknown model": lambda c: {"model": "affine3d"},
    "fewer candidates": lambda c: {"candidates": [[i, (i + 1) % 8] for i in range(8)]},
    "not a number": lambda c: with_row(c, "leaf_upper", (0, 5), np.nan),
    "other source": lambda c: {"source_digest": "0" * 64},
    "clouds exchanged": lambda c: {
        "source_digest": c.target_digest, "target_digest": c.source_digest,
    },
}  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_edited_certificate_is_refused(case, edit, tmp_path):
    """Each is sealed again, with the right checksum. Samples do not help the proof."""
    certificate, source, target = case
    object.__setattr__(certificate, "objective", objective_of(certificate, source, target))
    edited = dataclasses.replace(certificate, **EDITS[edit](certificate))
    write(tmp_path / "c.npz", edited)
    report = verify(tmp_path / "c.npz", source, target, n_samples=0)
    assert not report.accepted
    assert report.reason
    assert not report.statement


def false_statement(c, source, target, half):
    """A worse pose as the optimum; the leaves are the four facets times the octants of the start box."""
    facets = np.repeat(np.arange(4), 8)
    signs = np.tile(2 * (np.arange(8)[:, None] >> np.arange(3) & 1) - 1, (4, 1))
    lower = np.hstack(
        [-np.ones((32, 4)), np.minimum(signs, 0) * half[(signs > 0).astype(int), range(3)]]
    )
    upper = np.hstack(
        [np.ones((32, 4)), np.maximum(signs, 0) * half[(signs > 0).astype(int), range(3)]]
    )
    lower[np.arange(32), facets] = 1.0
    theta = c.theta + np.array([0.0, 0.1, -0.1, 0.1, 0.2, 0.1, 0.0])
    value = objective_of(c, source, target).value(theta)
    return dataclasses.replace(
        c, theta=theta, upper_bound=value, lower_bound=value, gap_tol=0.0, leaf_lower=lower,
        leaf_upper=upper, leaf_bounds=np.full(32, value), leaf_reasons=np.zeros(32),
        start_lower=lower.min(axis=0), start_upper=upper.max(axis=0),
        leaf_duals=np.empty((0, 0)), dual_units=np.empty(0),
    )  # fmt: skip


def test_a_start_box_whose_rounding_errors_prove_anything_is_refused(case):
    """The bounds of caps are differences; rounding raises all of them for one choice in thousands."""
    certificate, source, target = case
    half = 1e24 * np.random.default_rng(0).uniform(0.5, 1.0, (400_000, 2, 3))
    corners = np.stack(
        [half[:, [a, b, c], range(3)] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    )
    squares = ((0.5 * corners) ** 2).sum(axis=2)
    is_raised = (np.sqrt(squares) ** 2 < squares).all(axis=0)
    for chosen in half[is_raised]:
        report = verify(false_statement(certificate, source, target, chosen), source, target)
        assert "start box: larger than" in report.reason


def test_a_bound_that_is_no_number_proves_nothing(case):
    certificate, source, target = case
    false = false_statement(certificate, source, target, np.full((2, 3), 3.0))
    objective = objective_of(certificate, source, target)
    objective.cap_bound = lambda boxes, *_: np.full(len(boxes.centre), np.nan)
    proof = RigidProof(objective, 0.0, 200)
    with pytest.raises(format.CertificateError):
        proof.run(false, false.lower_bound)


def test_only_what_exceeds_rounding_is_stated():
    """A distant source point makes rounding errors larger than the objective."""
    rng = np.random.default_rng(1)
    source = rng.standard_normal((8, 3))
    target = source + 0.05 * rng.standard_normal((8, 3))
    source = np.vstack([source, [1e6, 0.0, 0.0]])
    c = register(
        source, target, n_inliers=8, model="rigid3d", mode="full", certificate=True, node_limit=300
    ).certificate  # fmt: skip
    theta = c.theta + np.array([0.0, 1e-6, 0.0, 0.0, 0.1, 0.2, 0.0])
    value = objective_of(c, source, target).value(theta)
    assert value > 2.0 * c.upper_bound
    false = dataclasses.replace(
        c, theta=theta, upper_bound=value, lower_bound=0.99 * value, gap_tol=0.01 * value,
        leaf_bounds=np.full(len(c.leaf_bounds), 0.99 * value),
    )  # fmt: skip
    report = verify(false, source, target)
    assert not report.accepted or report.lower_bound <= c.upper_bound * c.unit**2


def test_other_clouds_are_refused(case):
    certificate, source, target = case
    assert "source: differs" in verify(certificate, source + 1e-9, target).reason
    assert "target: differs" in verify(certificate, source, target[::-1]).reason
    assert "source: differs" in verify(certificate, target, source).reason


@pytest.mark.parametrize("change", ["truncated", "one byte"])
def test_damaged_file_is_refused(case, change, tmp_path):
    certificate, source, target = case
    write(tmp_path / "c.npz", certificate)
    content = bytearray((tmp_path / "c.npz").read_bytes())
    if change == "truncated":
        content = content[: len(content) // 2]
    else:
        content[len(content) // 2] ^= 0x10
    (tmp_path / "c.npz").write_bytes(content)
    assert not verify(tmp_path / "c.npz", source, target).accepted
