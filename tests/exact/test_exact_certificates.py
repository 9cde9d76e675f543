"""Proofs of 2D certificates in integers: a slice of `make exact`, forged certificates, and the bounds."""

import dataclasses
import itertools
import math
from contextlib import suppress
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from fractions import Fraction
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcreg.certificate import CertificateError, format
from dcreg.certificate.exact import ExactProof, P, decimal, is_rounding, rounded
from dcreg.certificate.verification import feasible_pairs, verify
from tests.certificates import rigid_case
from tests.exact.check import check, problems, with_gap
from tests.fuzz.problems import problem
from tests.oracles.kernels import k_assignment_brute_force
from tests.problems import SEEDS, cloud_pairs, register
from tests.unit.test_cli import run

CERTIFICATES = 15
MAX_BOXES = 500  # for leaves that a proof does not divide, 59 of the case


@pytest.fixture(scope="module")
def case():
    """A certificate of 5 pairs among 5 and 6 points; some leaf boxes have no admissible pose."""
    small = next(each for each in problems() if each.number == 61)
    certificate = small.solve().certificate
    assert certificate.status == "optimal"
    assert certificate.lower_bound > 0
    assert {*certificate.leaf_reasons} == {format.PRUNED, format.INADMISSIBLE}
    return certificate, small.source, small.target


def prove(certificate, source, target):
    """Run the exact checks alone."""
    feasible = feasible_pairs(certificate, len(source), len(target))
    proof = ExactProof(certificate, source, target, feasible, MAX_BOXES)
    proof.check(certificate)
    proof.run(certificate, certificate.lower_bound)


# --- true certificates ------------------------------------------------------------------------


def test_certificates_of_small_problems_are_proven_exactly():
    outcomes = [check(small) for small in islice(problems(rel_gap=0.3), CERTIFICATES)]
    assert not [one.fault for one in outcomes if one.fault]
    assert sum(one.kind == "proven" for one in outcomes) > CERTIFICATES // 2


def test_the_problems_have_candidates_and_ranges_of_scales():
    some = list(islice(problems(), 60))
    assert any(not small.allowed.all() for small in some)
    assert {low < high for low, high in (small.scale_range for small in some)} == {False, True}


def test_the_report_states_what_is_proven_exactly(case):
    certificate, source, target = case
    report = verify(certificate, source, target, exact=True)
    assert report.accepted, report.reason
    area = Fraction(certificate.unit) ** 2
    assert Fraction(report.lower_bound) <= Fraction(certificate.lower_bound) * area
    assert report.upper_bound == pytest.approx(certificate.upper_bound * float(area), rel=1e-12)
    assert "with scales from 0.3 to 0.36: " in report.statement
    low, high = map(Decimal, report.statement.partition(" lies exactly in [")[2][:-1].split(", "))
    assert Fraction(low) <= Fraction(certificate.lower_bound) * area
    assert low < high
    assert any("proven exactly on" in line for line in report.checks)


def test_the_command_proves_exactly_in_2d_only(tmp_path, case):
    certificate, source, target = case
    for name, points in (("a", source), ("b", target)):
        np.savetxt(tmp_path / f"{name}.txt", points, fmt="%.17g")
    format.write(tmp_path / "c.npz", certificate)
    done = run("verify", tmp_path / "c.npz", tmp_path / "a.txt", tmp_path / "b.txt", "--exact")
    assert done.exit_code == 0, done.output
    assert "lies exactly in [" in done.output
    other, *points = rigid_case()
    report = verify(other, *points, exact=True)
    assert not report.is_certificate  # nothing to check, so the command ends with code 2
    assert "no exact check for model 'rigid3d'" in report.reason


def test_a_scale_that_rounding_left_outside_is_moved_into_the_range():
    rng = np.random.default_rng(0)
    source = rng.standard_normal((6, 2))
    target = source @ np.array([[0.6, -0.8], [0.8, 0.6]]) + 0.05 * rng.standard_normal((6, 2))
    certificate = register(
        source, target, n_inliers=6, model="similarity2d", scale_range=(1.0, 1.0), certificate=True
    ).certificate
    a, b = map(Fraction, certificate.theta[:2])
    assert a * a + b * b != 1
    assert verify(certificate, source, target, exact=True).accepted


def test_only_candidates_attain_the_upper_bound_of_coincident_points():
    """All residuals are rounding errors there."""
    coincident = with_gap(problem(3643, "similarity2d"))
    assert not coincident.allowed.all()
    assert check(coincident).kind == "exact fit"


# --- forged certificates ----------------------------------------------------------------------


def with_entry(c, name, at, value):
    entries = getattr(c, name).copy()
    entries[at] = value
    return {name: entries}


def some(c, rows):
    names = ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")
    return {name: getattr(c, name)[rows] for name in names}


def moved_end(c, towards):
    """The upper end of a leaf moved by one unit in the last place."""
    leaf, axis = np.argwhere(c.leaf_upper < c.start_upper)[0]
    end = np.nextafter(c.leaf_upper[leaf, axis], towards)
    return with_entry(c, "leaf_upper", (leaf, axis), end)


def claims(c, bound):
    return {"lower_bound": bound, "leaf_bounds": np.where(c.leaf_reasons == 1, np.inf, bound)}


def worse_pose(c, factor):
    """A consistent claim of a worse pose, of which only the lower bound is false."""
    theta = c.theta + np.array([0.0, 0.0, 0.03, 0.0])
    value = c.upper_bound + c.n_inliers * 0.03**2  # residuals of the optimum have zero mean
    return {
        "theta": theta,
        "upper_bound": value,
        "gap_tol": value,
        **claims(c, factor * c.upper_bound),
    }


BIT = 1.0 + 1e-9
PRUNED_LEAF = 7
EDITS = {
    "lower bound raised": lambda c: {"lower_bound": BIT * c.lower_bound},
    "lower bound above the upper": lambda c: claims(c, BIT * c.upper_bound),
    "worse pose, bound above the optimum": lambda c: worse_pose(c, BIT),
    "leaf bound raised": lambda c: with_entry(
        c, "leaf_bounds", PRUNED_LEAF, BIT * c.leaf_bounds[PRUNED_LEAF]
    ),
    "leaf bound lowered": lambda c: with_entry(
        c, "leaf_bounds", PRUNED_LEAF, c.leaf_bounds[PRUNED_LEAF] / BIT
    ),
    "upper bound lowered": lambda c: {"upper_bound": c.upper_bound / BIT},
    "upper bound raised": lambda c: {"upper_bound": BIT * c.upper_bound},
    "first leaf removed": lambda c: some(c, slice(1, None)),
    "leaf removed": lambda c: some(c, np.arange(len(c.leaf_bounds)) != PRUNED_LEAF),
    "leaf repeated": lambda c: some(c, np.append(np.arange(len(c.leaf_bounds)), PRUNED_LEAF)),
    "leaf widened by one bit": lambda c: moved_end(c, np.inf),
    "leaf shrunk by one bit": lambda c: moved_end(c, -np.inf),
    "identity as the pose": lambda c: {"theta": np.array([1.0, 0.0, 0.0, 0.0])},
    "pose shifted": lambda c: {"theta": c.theta + np.array([0.0, 0.0, 1e-3, 0.0])},
    "pose turned around": lambda c: {"theta": c.theta * np.array([-1.0, -1.0, 1.0, 1.0])},
    "leaf called inadmissible": lambda c: {
        **with_entry(c, "leaf_reasons", PRUNED_LEAF, format.INADMISSIBLE),
        **with_entry(c, "leaf_bounds", PRUNED_LEAF, np.inf),
    },
    "one pair less": lambda c: {"n_inliers": c.n_inliers - 1},
    "other unit": lambda c: {"unit": BIT * c.unit},
    "wider range of scales": lambda c: {"scale_range": np.array([0.05, 3.0])},
}


@pytest.mark.parametrize("edit", EDITS)
def test_forged_certificates_are_refused(case, edit):
    """By the exact checks alone, and by all checks."""
    certificate, source, target = case
    forged = dataclasses.replace(certificate, **EDITS[edit](certificate))
    with pytest.raises(CertificateError):
        prove(forged, source, target)
    assert not verify(forged, source, target, exact=True, n_samples=0, max_boxes=MAX_BOXES).accepted


# --- the bounds -------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(cloud_pairs(2, max_points=4), SEEDS, st.sampled_from([0.0, 0.01, 0.1, 1.0]))
def test_no_box_is_proven_above_any_of_its_poses(problem, seed, size):
    """A bound of one unit more than the smallest value found: about 1e-36 of it."""
    source, target, k = problem
    rng = np.random.default_rng(seed)
    allowed = rng.random((len(source), len(target))) < 0.8
    allowed[np.arange(k), np.arange(k)] = True
    proof = ExactProof(bare(source, target, k), source, target, allowed, 100)
    scale = np.array([2**P, 2**P, int(proof.unit), int(proof.unit)], dtype=object)
    centre, half = rng.uniform(-1.0, 1.0, 4), size * rng.random(4) * (rng.random(4) < 0.8)
    lower, upper = integers(centre - half, scale), integers(centre + half, scale)
    poses = [
        np.array(pose, dtype=object) for pose in itertools.product(*zip(lower, upper, strict=True))
    ]
    poses += [lower + (upper - lower) * int(share * 1000) // 1000 for share in rng.random(10)]
    inside = [pose for pose in poses if not proof._is_outside(pose, pose)]
    if not inside:
        return
    values = []
    for pose in inside:
        cost = proof._costs(pose, pose)
        values.append(k_assignment_brute_force(np.where(allowed, cost, 10**200), k))
    needed = int(min(values)) + 1
    with suppress(CertificateError):  # refuted by the pose at the centre
        assert not proof._is_proven(0, lower, upper, needed)


def integers(values, scale):
    return np.array([math.floor(Fraction(v) * s) for v, s in zip(values, scale, strict=True)])


def bare(source, target, k):
    """A certificate that states nothing but the problem."""
    flat = np.zeros((1, 4))
    return format.Certificate(
        source_digest="", target_digest="", model="similarity2d", mode="", bound="", status="",
        n_inliers=k, scale_range=np.array([0.5, 1.5]), source_centre=source.mean(axis=0),
        target_centre=target.mean(axis=0), unit=0.7, start_lower=flat[0], start_upper=flat[0],
        leaf_lower=flat, leaf_upper=flat, leaf_bounds=np.zeros(1), leaf_reasons=np.zeros(1),
        theta=flat[0], lower_bound=0.0, upper_bound=0.0, gap_tol=0.0,
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(cloud_pairs(2, max_points=5))
def test_the_region_contains_the_translations_of_all_fits(problem):
    source, target, k = problem
    proof = ExactProof(bare(source, target, k), source, target, None, 100)
    region = proof._region()
    sums = [sum(rows) for rows in itertools.combinations(proof.x, k)]
    longest = max((z * z).sum() for z in sums)
    target_sums = [sum(rows) for rows in itertools.combinations(proof.y, k)]
    for axis, (sign, ends) in itertools.product(range(2), zip((-1, 1), region, strict=True)):
        reach = k * sign * ends[2 + axis] - max(sign * z[axis] for z in target_sums)
        assert reach >= 0
        assert reach**2 >= longest * proof.high**2


@pytest.mark.parametrize(
    "number", [Fraction(1, 3), Fraction(10**30 + 1, 7), Fraction(1, 10**20 + 3)]
)
def test_numbers_are_rounded_outwards(number):
    assert Fraction(Decimal(decimal(number, ROUND_FLOOR))) <= number
    assert Fraction(Decimal(decimal(number, ROUND_CEILING))) >= number
    low, high = rounded(number, -np.inf), rounded(number, np.inf)
    assert Fraction(low) < number < Fraction(high)
    assert np.nextafter(low, np.inf) == high


@given(st.fractions(0, 10), st.fractions(0, 10), st.fractions(0, 1))
def test_rounding_compares_the_roots(one, other, residual):
    apart = abs(math.sqrt(one) - math.sqrt(other)) - math.sqrt(residual)
    if abs(apart) > 1e-9:
        assert is_rounding(one, other, residual, Fraction(0)) == (apart < 0)
