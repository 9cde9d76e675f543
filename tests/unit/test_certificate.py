"""Certificates: true ones are accepted, false ones refused with the reason."""

import dataclasses
import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dcreg
from dcreg.certificate import CertificateError, format, statement, verification
from dcreg.certificate.objectives import OBJECTIVES
from dcreg.certificate.proof import Proof, check_partition
from dcreg.certificate.verification import check_samples, objective_of, verify
from dcreg.problem import exact_objective
from dcreg.status import Status
from tests.certificates import DIM, certify, check, clouds, made_case, refused
from tests.fuzz.problems import problem as fuzz_problem
from tests.problems import register


@pytest.fixture(scope="module", params=DIM)
def case(request):
    return made_case(request.param)


# --- real certificates ------------------------------------------------------------------------


@pytest.mark.parametrize("model", DIM)
@pytest.mark.parametrize(
    ("bound", "options"),
    [
        ("dc", {}),
        ("dc", {"reduced": False, "nodes": 3000}),
        ("dc+interval", {"nodes": 40}),
        ("interval", {"tau": 0.1, "nodes": 3000}),
        ("tight", {}),
    ],
)
@pytest.mark.parametrize("extra", [0, 3])
def test_real_certificates_are_accepted(tmp_path, model, bound, options, extra):
    source, target = clouds(model, n=8, extra=extra, seed=1)
    certificate = certify(source, target, 8, model, bound=bound, **options)
    report = check(tmp_path, certificate, source, target)
    assert report.accepted, report.reason
    area = certificate.unit**2
    assert report.lower_bound == certificate.lower_bound * area
    assert report.upper_bound == certificate.upper_bound * area
    assert f"{report.upper_bound:.9g}" in report.statement
    assert len(report.checks) == 8


def test_a_search_that_hit_a_limit_has_valid_bounds(tmp_path):
    source, target = clouds("similarity2d")
    certificate = certify(source, target, 10, "similarity2d", bound="dc", nodes=200)
    assert certificate.status == "node_limit"
    assert (certificate.leaf_reasons == 2).any()
    assert check(tmp_path, certificate, source, target).accepted
    claims_more = dataclasses.replace(certificate, status="optimal")
    report = check(tmp_path, claims_more, source, target)
    assert "status optimal does not follow" in report.reason


def test_certificate_in_memory_is_checked_like_its_file(tmp_path, case):
    certificate, source, target = case
    in_memory = verify(certificate, source, target)
    on_disk = check(tmp_path, certificate, source, target)
    assert in_memory.accepted
    assert in_memory.checks[0].startswith("complete: ")
    assert in_memory.checks[1:] == on_disk.checks[1:]
    assert in_memory.statement == on_disk.statement
    false = dataclasses.replace(certificate, upper_bound=0.99 * certificate.upper_bound)
    assert "upper_bound: " in verify(false, source, target).reason
    for name in ("theta", "leaf_reasons"):
        broken = dataclasses.replace(certificate, **{name: getattr(certificate, name)[:-1]})
        assert f"{name}: shape" in verify(broken, source, target).reason


def test_result_is_verified_in_memory():
    source, target = clouds("similarity2d", n=8, extra=0)
    asked = {"n_inliers": 8, "model": "similarity2d", "rel_gap": 0.0, "abs_gap": 0.5}
    result = register(source, target, **asked, certificate=True)
    report = dcreg.verify(result.certificate, source, target)
    assert report.accepted, report.reason
    assert report.lower_bound == pytest.approx(result.lower_bound, rel=1e-12)
    without = dcreg.register(source, target, **asked)
    assert "certificate=True" in dcreg.verify(without.certificate, source, target).reason


@pytest.mark.parametrize(
    ("model", "extra"), [("similarity2d", 1), ("rigid3d", 1), ("rigid3d", -1), ("translation3d", 1)]
)
def test_the_report_has_the_pose_of_the_certificate(model, extra, rng):
    """Also if the target is the smaller cloud, which then moves in the check."""
    dim = 2 if model == "similarity2d" else 3
    source = rng.standard_normal((6, dim))
    target = np.vstack([source[::-1], 2.0 * rng.standard_normal((2, dim))])[: 6 + extra] + 3.0
    target += 0.01 * rng.standard_normal(target.shape)
    result = dcreg.register(
        source, target, n_inliers=5, model="similarity2d" if dim == 2 else "rigid3d",
        options=dcreg.SolveOptions(
            certificate=True, mode="paper" if model == "translation3d" else None
        ),
    )  # fmt: skip
    report = dcreg.verify(result.certificate, source, target)
    assert report.accepted, report.reason
    assert report.model == model
    if model == "translation3d":
        assert report.poses == {}
        return
    (T,) = report.poses.values()
    np.testing.assert_allclose(T, result.T_certified, atol=1e-9)
    value, _ = dcreg.objective(source, target, T, 5)
    assert value == pytest.approx(report.upper_bound)
    assert json.loads(report.to_json())["T_target_source"] == T.tolist()


def test_progress_ends_with_all_boxes_done(case):
    certificate, source, target = case
    reported = []
    report = verify(certificate, source, target, progress=lambda *seen: reported.append(seen))
    done, needed = map(list, zip(*reported, strict=True))
    assert done == sorted(done)
    assert needed == sorted(needed)
    assert reported[-1] == (report.n_boxes, report.n_boxes)


def test_every_leaf_has_its_reason(tmp_path):
    source, target = clouds("similarity2d", extra=1)
    certificate = certify(
        source, target, 10, "similarity2d", bound="dc", nodes=400, scale_range=(0.9, 1.1)
    )
    counts = [
        (certificate.leaf_reasons == reason).sum()
        for reason in (format.PRUNED, format.INADMISSIBLE, format.OPEN)
    ]
    assert min(counts) > 0
    assert sum(counts) == len(certificate.leaf_reasons)
    report = check(tmp_path, certificate, source, target)
    assert report.accepted, report.reason


# --- false statements -------------------------------------------------------------------------


def test_other_clouds_are_refused(tmp_path, case):
    certificate, source, target = case
    moved = source + 1e-12
    assert "source: differs from" in check(tmp_path, certificate, moved, target).reason
    assert "target: differs from" in check(tmp_path, certificate, source, target[::-1]).reason
    assert "source: differs from" in check(tmp_path, certificate, target, source).reason


def test_clouds_of_another_dimension_are_refused(case):
    certificate = case[0]
    dim = 5 - len(certificate.source_centre)
    points = np.zeros((10, dim))
    digest = format.digest(points)
    forged = dataclasses.replace(certificate, source_digest=digest, target_digest=digest)
    assert "source: shape" in verify(forged, points, points).reason


def test_raised_bound_is_refuted(tmp_path, case):
    certificate = case[0]
    at_optimum = np.flatnonzero(
        ((certificate.leaf_lower <= certificate.theta)
         & (certificate.theta <= certificate.leaf_upper)).all(axis=1)
    )[0]  # fmt: skip
    bounds = certificate.leaf_bounds.copy()
    bounds[at_optimum] = 1.01 * certificate.upper_bound
    refused(tmp_path, case, "bound is false", leaf_bounds=bounds)


def test_every_bound_raised_above_its_minimum_is_refused(tmp_path, case, rng):
    """Also if the claim does not depend on it."""
    certificate = case[0]
    finite = np.flatnonzero(np.isfinite(certificate.leaf_bounds))
    for leaf in rng.choice(finite, 5):
        bounds = certificate.leaf_bounds.copy()
        bounds[leaf] += 1e3
        refused(tmp_path, case, "bound is false", leaf_bounds=bounds)


def test_samples_find_a_false_bound(case):
    certificate, objective = case[0], objective_of(*case)
    assert check_samples(objective, certificate, 1e-9, 300) > 100
    false = dataclasses.replace(certificate, leaf_bounds=certificate.leaf_bounds + 1e3)
    with pytest.raises(CertificateError, match="bound is false"):
        check_samples(objective, false, 1e-9, 300)


def test_lowered_bound_does_not_imply_the_claim(tmp_path, case):
    bounds = case[0].leaf_bounds.copy()
    bounds[7] = 0.0
    refused(tmp_path, case, "does not follow: leaf 7", leaf_bounds=bounds)


def test_removed_leaf_is_a_gap(tmp_path, case, rng):
    certificate = case[0]
    for leaf in rng.integers(len(certificate.leaf_bounds), size=10):
        rest = {
            name: np.delete(getattr(certificate, name), leaf, axis=0)
            for name in ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")
        }
        refused(tmp_path, case, "a gap", **rest)


def test_repeated_or_grown_leaf_is_an_overlap(tmp_path, case):
    certificate = case[0]
    twice = {
        name: np.concatenate([getattr(certificate, name), getattr(certificate, name)[:1]])
        for name in ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")
    }
    refused(tmp_path, case, "overlap", **twice)
    inner = np.flatnonzero((certificate.leaf_upper < certificate.start_upper - 0.1).any(axis=1))[0]
    grown = certificate.leaf_upper.copy()
    axis = np.argmax(certificate.start_upper - grown[inner])
    grown[inner, axis] += 0.03
    refused(tmp_path, case, "leaves: ", leaf_upper=grown)


def test_shifted_or_smaller_start_box_is_refused(tmp_path, case):
    certificate = case[0]
    names = ("start_lower", "start_upper", "leaf_lower", "leaf_upper")
    shifted = {name: getattr(certificate, name) + 0.2 for name in names}
    refused(tmp_path, case, "start box: axis 0", **shifted)
    # a clean cover of half of the box
    middle = 0.5 * (certificate.start_lower[0] + certificate.start_upper[0])
    half = certificate.leaf_upper[:, 0] <= middle
    leaves = ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")
    kept = {name: getattr(certificate, name)[half] for name in leaves}
    upper = certificate.start_upper.copy()
    upper[0] = middle
    refused(tmp_path, case, "start box: axis 0", start_upper=upper, **kept)


def test_wrong_n_inliers_is_refused(tmp_path, case):
    refused(tmp_path, case, "start box", n_inliers=9)  # fewer pairs can have extremer means
    refused(tmp_path, case, "upper_bound: ", n_inliers=11)
    refused(tmp_path, case, "exceeds the smaller cloud", n_inliers=99)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_messages_state_the_units_of_the_clouds(unit):
    rng = np.random.default_rng(4)
    source = unit * rng.random((8, 2))
    target = source + unit * (3.0 + 0.05 * rng.standard_normal((8, 2)))
    options = dcreg.SolveOptions(certificate=True)
    result = dcreg.register(source, target, n_inliers=8, model="similarity2d", options=options)
    made, value = result.certificate, f"{result.upper_bound:.6g}"[:-1]
    report = verify(made, source, target)
    assert f"[{result.lower_bound:.9g}, {result.upper_bound:.9g}]" in report.statement
    assert f"attains {value}" in "\n".join(report.checks)
    moved = verify(dataclasses.replace(made, theta=made.theta + 0.01), source, target)
    assert f"upper_bound: {value}" in moved.reason
    half = 0.5 * made.upper_bound
    low = verify(dataclasses.replace(made, upper_bound=half, lower_bound=half), source, target)
    assert f"the objective at theta is {value}" in low.reason
    false = dataclasses.replace(made, leaf_bounds=made.leaf_bounds + made.upper_bound)
    found = re.search(r"has the objective ([\d.]+), below", verify(false, source, target).reason)
    assert 1.0 <= float(found[1]) / result.upper_bound <= 2.0


def test_wrong_optimum_is_refused(tmp_path, case):
    certificate = case[0]
    refused(tmp_path, case, "upper_bound: ", theta=certificate.theta + 0.01)
    refused(tmp_path, case, "upper_bound: ", upper_bound=0.99 * certificate.upper_bound)
    refused(tmp_path, case, "does not follow", lower_bound=certificate.upper_bound)
    refused(tmp_path, case, "does not lie in [0", lower_bound=-1.0)
    refused(tmp_path, case, "was pruned with the bound", gap_tol=1e-9, status="stopped")
    refused(tmp_path, case, "unit", unit=-1.0)
    refused(tmp_path, case, "theta: not a finite number", theta=certificate.theta * np.nan)


def one_leaf(certificate, box, theta, value, bound):
    """A certificate of another statement with a single leaf, the start box."""
    return dataclasses.replace(
        certificate, start_lower=-box, start_upper=box, leaf_lower=-box[None], leaf_upper=box[None],
        leaf_bounds=[bound], leaf_reasons=[format.OPEN], theta=theta, upper_bound=value,
        lower_bound=bound, gap_tol=value - bound, status="stopped",
    )  # fmt: skip


def test_the_unit_cannot_be_exchanged(case):
    """In a very large unit, every claim is within the rounding error."""
    certificate, source, target = case
    box = np.full(len(certificate.theta), 10.0)
    forged = one_leaf(certificate, box, 0.0 * box + 1e-9, 5e-12, 5e-12)
    scales = [1e-9, 1.0] if certificate.model == "similarity2d" else [1.0, 1.0]
    forged = dataclasses.replace(forged, unit=1e9 * certificate.unit, scale_range=scales)
    assert "unit: " in verify(forged, source, target).reason


@pytest.mark.parametrize("name", ["source_centre", "target_centre"])
def test_another_centre_is_refused(tmp_path, case, name):
    refused(tmp_path, case, name, **{name: getattr(case[0], name) + 1e-3})


def test_rounding_does_not_depend_on_the_value_of_a_far_pose(case):
    certificate, source, target = case
    theta = np.append(certificate.theta[:-1], 1e6)
    value = objective_of(*case).value(theta)
    box = np.maximum(-certificate.start_lower, certificate.start_upper)
    forged = one_leaf(certificate, box, theta, value, 0.9e-9 * value)
    assert not verify(forged, source, target, n_samples=0).accepted


def test_a_huge_start_box_hides_no_gap():
    end, gap = np.full(2, 1e13), 4.0
    lower, upper = np.stack([-end, -end]), np.stack([end, end])
    upper[0, 0], lower[1, 0] = -gap, gap
    with pytest.raises(CertificateError, match="a gap"):
        check_partition(-end, end, lower, upper)


def test_a_local_optimum_is_refused(tmp_path, case):
    """All entries are consistent, but the objective is lower elsewhere."""
    certificate = case[0]
    objective = objective_of(*case)
    theta = certificate.theta + 0.05
    value = objective.value(theta)
    assert value > certificate.upper_bound + certificate.gap_tol
    lower_bound = value - certificate.gap_tol
    bounds = np.maximum(certificate.leaf_bounds, lower_bound)
    claim = {"theta": theta, "upper_bound": value, "lower_bound": lower_bound}
    refused(tmp_path, case, "bound is false", leaf_bounds=bounds, **claim)


def test_leaves_stated_as_inadmissible_are_checked(tmp_path, case):
    certificate = case[0]
    reasons, bounds = certificate.leaf_reasons.copy(), certificate.leaf_bounds.copy()
    leaf = int(np.argmin(bounds))
    reasons[leaf] = 1
    bounds[leaf] = np.inf
    refused(tmp_path, case, f"leaf {leaf}", leaf_reasons=reasons, leaf_bounds=bounds)


def test_scale_outside_of_the_range_is_refused(tmp_path):
    source, target = clouds("similarity2d")
    certificate = certify(source, target, 10, "similarity2d", bound="dc")
    case = certificate, source, target
    refused(tmp_path, case, "theta: not an admissible", scale_range=np.array([0.1, 0.2]))
    refused(tmp_path, case, "start box", scale_range=np.array([0.5, 3.0]))


def test_too_many_pairs_are_refused(tmp_path, case, monkeypatch):
    certificate, source, target = case
    monkeypatch.setattr(verification, "MAX_DENSE", 100)
    assert "11 x 11 pairs exceed 100" in check(tmp_path, certificate, source, target).reason


def test_any_number_of_points_is_checked_in_sorted_order(tmp_path, monkeypatch):
    monkeypatch.setattr(verification, "MAX_DENSE", 100)
    source, target = clouds("translation3d", n=12, extra=0)
    certificate = certify(source, target, 12, "translation3d", bound="dc", nodes=500)
    report = check(tmp_path, certificate, source, target)
    assert report.accepted
    assert report.n_assignments == 0


def test_a_proof_beyond_max_boxes_is_refused(tmp_path, case):
    certificate, source, target = case
    report = check(tmp_path, certificate, source, target, max_boxes=5)
    assert "could not be confirmed within 5 boxes" in report.reason


def test_a_bound_that_boxes_never_confirm_gives_way_to_the_tolerance():
    """Of three source points two coincide, and two have pairs: a whole surface of poses is optimal."""
    problem = fuzz_problem(1073)
    result = problem.solve()
    assert result.upper_bound - result.lower_bound < 1e-6 < result.gap_tol
    report = dcreg.verify(result.certificate, problem.source, problem.target)
    assert report.accepted, report.reason
    assert report.lower_bound == pytest.approx(result.upper_bound - result.gap_tol)
    assert "could not be confirmed" in report.checks[-2]
    assert f"[{report.lower_bound:.9g}, {report.upper_bound:.9g}]" in report.statement


# --- what the claim depends on ------------------------------------------------------------------


@st.composite
def claims(draw):
    """A certificate of an unfinished search, and a claim above the best known value."""
    model = draw(st.sampled_from(sorted(DIM)))
    seed = draw(st.integers(0, 2**32 - 1))
    generator = np.random.default_rng(seed)
    k = draw(st.integers(3, 6))
    source, target = clouds(model, n=k, extra=draw(st.integers(0, 2)), seed=seed)
    true = certify(source, target, k, model, bound="dc", nodes=draw(st.integers(1, 60)))
    objective = objective_of(true, source, target)
    while True:  # a worse pose passed off as the best
        step = 10.0 ** generator.uniform(-3, 0) * generator.standard_normal(len(true.theta))
        theta = true.theta + step
        value = objective.value(theta)
        if objective.admissible(theta[None])[0] and value > true.upper_bound + 1e-6:
            break
    share = draw(st.sampled_from([1e-2, 0.5, 1.0]))
    lower_bound = true.upper_bound + share * (value - true.upper_bound)
    reasons, bounds = true.leaf_reasons.copy(), np.maximum(true.leaf_bounds, lower_bound)
    if draw(st.booleans()):  # leaves said to hold no admissible parameter
        said = generator.random(len(reasons)) < draw(st.sampled_from([0.1, 1.0]))
        reasons[said], bounds[said] = format.INADMISSIBLE, np.inf
    elif draw(st.booleans()):
        bounds *= draw(st.sampled_from([1.0, 2.0]))
    false = dataclasses.replace(
        true, theta=theta, upper_bound=value, lower_bound=lower_bound, gap_tol=value - lower_bound,
        status="optimal", leaf_bounds=bounds, leaf_reasons=reasons,
    )  # fmt: skip
    return true, false, source, target


@settings(max_examples=40)
@given(claims())
def test_a_lower_bound_above_the_optimum_is_always_refused(claim):
    """Whatever its leaves state; the same leaves with the true claim are accepted."""
    true, false, source, target = claim
    for n_samples in (0, 100):
        report = verify(false, source, target, max_boxes=400, n_samples=n_samples)
        assert not report.accepted
        assert re.search("bound is false|could not be confirmed|inadmissible|no adm", report.reason)
    report = verify(true, source, target)
    assert report.accepted, report.reason


def test_a_bound_of_zero_needs_no_proof(monkeypatch):
    """Whatever bounds the leaves state; false ones among them are still refused."""
    source, target = clouds("translation3d", extra=1)
    certificate = certify(source, target, 10, "translation3d", bound="dc", nodes=300, tau=0.01)
    assert certificate.lower_bound == 0
    assert (certificate.leaf_bounds > 0).any()
    false = certificate.leaf_bounds.copy()
    false[false.argmax()] += 1e3

    def never(*_):
        pytest.fail("a bound is computed")

    for owner, name in (
        (OBJECTIVES["translation3d"], "nearest_bound"),
        (OBJECTIVES["translation3d"], "interval_bound"),
        (Proof, "tangent_bound"),
    ):
        monkeypatch.setattr(owner, name, never)
    report = verify(certificate, source, target)
    assert report.accepted, report.reason
    assert report.is_trivial
    n_leaves = len(certificate.leaf_bounds)
    assert (
        report.checks[-1]
        == f"on every leaf the objective is at least 0, proven on {n_leaves} boxes"
    )
    forged = dataclasses.replace(certificate, leaf_bounds=false)
    assert "bound is false" in verify(forged, source, target, n_samples=0).reason


def test_a_lower_bound_of_zero_is_trivial_in_2d_too(rng):
    source = rng.random((12, 2))
    target = source + 1e-3 * rng.standard_normal((12, 2))
    settings = {"n_inliers": 12, "model": "similarity2d", "certificate": True}
    found = register(source, target, **settings, tol=0.01)
    assert found.status is Status.CONVERGED
    assert found.lower_bound == 0 < found.upper_bound
    report = verify(found.certificate, source, target)
    assert report.accepted, report.reason
    assert report.is_trivial
    forged = dataclasses.replace(found.certificate, status="optimal")
    assert "status optimal does not follow: the lower bound is 0" in (
        verify(forged, source, target).reason
    )
    exact = register(source, source, **settings)
    assert exact.status is Status.OPTIMAL
    report = verify(exact.certificate, source, source)
    assert report.accepted, report.reason
    assert not report.is_trivial


def test_the_report_states_what_was_proven(case):
    certificate, source, target = case
    area = certificate.unit**2
    for share in (1.0, 0.5):
        claimed = dataclasses.replace(
            certificate, lower_bound=share * certificate.lower_bound, status="stopped"
        )
        report = verify(claimed, source, target)
        assert report.checks[-1] == (
            f"on every leaf the objective is at least {claimed.lower_bound * area:.9g}, "
            f"proven on {report.n_boxes} boxes"
        )


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_the_limit_of_an_exact_fit_is_that_of_the_search(far):
    """The check computes it on its own; a far point does not raise it."""
    source, target = clouds("similarity2d")
    if far:
        source, target = (np.vstack([cloud, np.full((1, 2), far)]) for cloud in (source, target))
    certificate = certify(source, target, 8, "similarity2d", bound="dc", nodes=50)
    found = statement.exact_up_to(certificate, source, target) * certificate.unit**2
    assert found == pytest.approx(exact_objective(source, target, 8), rel=1e-6)
