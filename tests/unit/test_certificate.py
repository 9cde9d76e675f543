"""Certificates: real ones are accepted, broken ones refused with the reason, by independent code."""

import dataclasses
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dcreg
from dcreg.certificate import (
    Certificate,
    CertificateError,
    format,
    proof,
    read,
    verification,
    write,
)
from dcreg.certificate.cover import check_cover
from dcreg.certificate.families import FAMILIES
from dcreg.certificate.prices import cheapest_pairs, prices_of
from dcreg.certificate.proof import Proof
from dcreg.certificate.record import record
from dcreg.certificate.verification import check_samples, verify
from dcreg.families.registry import make_bound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import Frame, Problem
from dcreg.search import Budget, LongestEdge, minimise
from dcreg.search import boxes as leaves
from tests.problems import models_with_boxes, register

DIM = {"similarity2d": 2, "translation3d": 3}


def clouds(model, n=10, extra=3, seed=0):
    """A rotated noisy copy among outliers."""
    generator = np.random.default_rng(seed)
    dim = DIM[model]
    source = generator.standard_normal((n, dim)) * [1.0, 0.6, 0.4][:dim]
    rotation, _ = np.linalg.qr(generator.standard_normal((dim, dim)))
    rotation[0] *= np.linalg.det(rotation)
    target = source @ rotation.T + 0.3 + 0.1 * generator.standard_normal((n, dim))
    outliers = generator.standard_normal((2, extra, dim))
    return np.vstack([source, outliers[0]]), np.vstack([target, outliers[1]])


def certify(
    source, target, n_inliers, model,
    *, bound, tau=0.04, nodes=None, reduced=True, scale_range=None,
):  # fmt: skip
    """Search with the library's own parts and state the outcome."""
    family = "rigid3d" if model == "translation3d" else model
    problem = Problem(source, target, n_inliers, family, scale_range)
    frame = Frame.of(problem)
    points = frame.source(source), frame.target(target), n_inliers
    space = (
        Translation3D(*points, reduced)
        if model == "translation3d"
        else Similarity2D(*points, problem.scale_range, reduced)
    )
    theta, value, _ = space.refine(space.identity)
    searched, gap_tol = make_bound(bound, space), n_inliers * tau**2
    found = minimise(
        space,
        searched,
        Budget(nodes=nodes),
        gap_tol=gap_tol,
        start=(theta, value),
        keep_leaves=True,
    )
    return record(
        found, found.leaves, searched.roots[0], problem,
        family=model, mode="paper", bound=bound, gap_tol=gap_tol,
    )  # fmt: skip


@pytest.fixture(scope="module", params=["similarity2d", "translation3d"])
def case(request):
    source, target = clouds(request.param, extra=1)
    tau = {"similarity2d": 0.06, "translation3d": 0.035}[request.param]
    certificate = certify(source, target, 10, request.param, bound="dc", tau=tau)
    assert certificate.status == "optimal"
    assert len(certificate.leaf_bounds) > 20
    assert certificate.lower_bound > 0
    return certificate, source, target


def check(tmp_path, certificate, source, target, **options):
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    return verify(path, source, target, **options)


def family_of(case):
    certificate, source, target = case
    return FAMILIES[certificate.model](
        (source - certificate.source_centre) / certificate.unit,
        (target - certificate.target_centre) / certificate.unit,
        certificate.n_inliers,
        tuple(certificate.scale_range),
    )


def refused(tmp_path, case, reason, **changes):
    """The certificate with some entries changed, and sealed again, is refused for `reason`.

    Without samples: the proof has to find a false bound by itself.
    """
    certificate, source, target = case
    changed = dataclasses.replace(certificate, **changes)
    report = check(tmp_path, changed, source, target, n_samples=0)
    assert not report.accepted
    assert not report.statement
    assert reason in report.reason


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


def test_limit_is_stated_with_its_valid_bounds(tmp_path):
    source, target = clouds("similarity2d")
    certificate = certify(source, target, 10, "similarity2d", bound="dc", nodes=200)
    assert certificate.status == "node_limit"
    assert (certificate.leaf_reasons == 2).any()
    assert check(tmp_path, certificate, source, target).accepted
    claims_more = dataclasses.replace(certificate, status="optimal")
    report = check(tmp_path, claims_more, source, target)
    assert "status optimal does not follow" in report.reason


def test_file_holds_what_was_written_as_plain_arrays(tmp_path, case):
    certificate = case[0]
    write(tmp_path / "a.npz", certificate)
    again = read(tmp_path / "a.npz")
    for entry in dataclasses.fields(Certificate):
        np.testing.assert_array_equal(
            getattr(again, entry.name), getattr(certificate, entry.name), err_msg=entry.name
        )
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


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
    broken = dataclasses.replace(certificate, theta=certificate.theta[:-1])
    assert "theta: shape" in verify(broken, source, target).reason


def test_result_is_verified_in_memory():
    source, target = clouds("similarity2d", n=8, extra=0)
    asked = {"n_inliers": 8, "model": "similarity2d", "gap_tol": 0.5}
    result = register(source, target, **asked, certificate=True)
    report = dcreg.verify(result.certificate, source, target)
    assert report.accepted, report.reason
    assert report.lower_bound == pytest.approx(result.lower_bound, rel=1e-12)
    without = dcreg.register(source, target, **asked)
    assert "certificate=True" in dcreg.verify(without.certificate, source, target).reason


def test_progress_ends_with_all_boxes_done(case):
    certificate, source, target = case
    told = []
    report = verify(certificate, source, target, progress=lambda *seen: told.append(seen))
    done, needed = map(list, zip(*told, strict=True))
    assert done == sorted(done)
    assert needed == sorted(needed)
    assert told[-1] == (report.n_boxes, report.n_boxes)


# The search and the file format number the reasons of a leaf each for itself; record.py translates.
@pytest.mark.parametrize(
    ("module", "code"),
    [(leaves, name) for name in ("PRUNED", "EMPTY", "OPEN")]
    + [(format, name) for name in ("PRUNED", "INADMISSIBLE", "OPEN")],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_reasons_of_leaves_may_be_renumbered(tmp_path, monkeypatch, module, code):
    changed = [module] if module is leaves else [format, verification, proof]
    for each in changed:
        if hasattr(each, code):
            monkeypatch.setattr(each, code, 7)
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


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch, case):
    path = tmp_path / "certificate.npz"
    write(path, case[0])
    before = path.read_bytes()

    def full_disk(file, **_):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(format.np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="no space left"):
        write(path, case[0])
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["certificate.npz"]


# --- broken files -----------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_file_is_refused(tmp_path, case, share):
    certificate, source, target = case
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    report = verify(path, source, target)
    assert not report.accepted
    assert "not a readable certificate" in report.reason


def test_flipped_bytes_never_change_what_is_accepted(tmp_path, case, rng):
    certificate = case[0]
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    content = path.read_bytes()
    n_refused = 0
    for at in rng.integers(len(content), size=150):
        broken = bytearray(content)
        broken[at] ^= 0x55
        path.write_bytes(broken)
        try:
            kept = read(path)  # a zip holds bytes without meaning, such as time stamps
        except CertificateError:
            n_refused += 1
        else:
            np.testing.assert_array_equal(kept.leaf_bounds, certificate.leaf_bounds)
            np.testing.assert_array_equal(kept.theta, certificate.theta)
    assert n_refused > 100


def test_changed_entry_without_a_new_seal_is_refused(tmp_path, case):
    certificate, source, target = case
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    with np.load(path) as file:
        arrays = dict(file)
    for name in ("leaf_bounds", "theta", "n_inliers", "source_digest"):
        changed = arrays[name].copy()
        changed.flat[0] = changed.flat[0] + (1 if changed.dtype.kind != "U" else "x")
        if changed.dtype.kind == "U":
            changed = np.array(str(arrays[name])[::-1])
        np.savez(path, **(arrays | {name: changed}))
        assert "checksum" in verify(path, source, target).reason
    np.savez(path, **{name: array for name, array in arrays.items() if name != "leaf_bounds"})
    assert "wrong entries: ['leaf_bounds']" in verify(path, source, target).reason
    np.savez(path, **(arrays | {"format_version": np.array(99)}))
    assert "format version" in verify(path, source, target).reason


class Payload:
    """Unpickling it leaves a mark."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_pickles_are_refused_and_not_run(tmp_path, case):
    certificate, source, target = case
    mark, path = tmp_path / "mark", tmp_path / "certificate.npz"
    write(path, certificate)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {"theta": np.array([Payload(mark)], dtype=object)}))
    assert "not a readable certificate" in verify(path, source, target).reason
    path.write_bytes(pickle.dumps(Payload(mark)))
    assert "not a readable certificate" in verify(path, source, target).reason
    assert not mark.exists()


def test_other_files_are_refused(tmp_path, case):
    _, source, target = case
    path = tmp_path / "other.npz"
    assert "no such file" in verify(path, source, target).reason
    np.savez(path, x=np.zeros(3))
    assert "not a dcreg leaf cover" in verify(path, source, target).reason
    path.write_text("{}")
    assert "not a readable certificate" in verify(path, source, target).reason
    np.save(tmp_path / "one.npy", np.zeros(3))
    report = verify(tmp_path / "one.npy", source, target)
    assert "not a readable certificate" in report.reason
    assert not report.is_certificate
    assert "allow_pickle" not in report.reason


# --- false statements -------------------------------------------------------------------------


def test_other_clouds_are_refused(tmp_path, case):
    certificate, source, target = case
    moved = source + 1e-12
    assert "source: other data" in check(tmp_path, certificate, moved, target).reason
    assert "target: other data" in check(tmp_path, certificate, source, target[::-1]).reason
    assert "source: other data" in check(tmp_path, certificate, target, source).reason


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
    """Not only where it matters for the conclusion."""
    certificate = case[0]
    finite = np.flatnonzero(np.isfinite(certificate.leaf_bounds))
    for leaf in rng.choice(finite, 5):
        bounds = certificate.leaf_bounds.copy()
        bounds[leaf] += 1e3
        refused(tmp_path, case, "bound is false", leaf_bounds=bounds)


def test_samples_find_a_false_bound(case):
    certificate, family = case[0], family_of(case)
    assert check_samples(family, certificate, 1e-9, 300) > 100
    false = dataclasses.replace(certificate, leaf_bounds=certificate.leaf_bounds + 1e3)
    with pytest.raises(CertificateError, match="bound is false"):
        check_samples(family, false, 1e-9, 300)


def test_lowered_bound_does_not_carry_the_conclusion(tmp_path, case):
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
    """The certificate of another statement, which rests on one leaf that fills the start box."""
    return dataclasses.replace(
        certificate, start_lower=-box, start_upper=box, leaf_lower=-box[None], leaf_upper=box[None],
        leaf_bounds=[bound], leaf_reasons=[format.OPEN], theta=theta, upper_bound=value,
        lower_bound=bound, gap_tol=value - bound, status="stopped",
    )  # fmt: skip


def test_rounding_is_not_measured_by_another_unit(case):
    """In so large a unit every claim is as small as rounding."""
    certificate, source, target = case
    box = np.full(len(certificate.theta), 10.0)
    forged = one_leaf(certificate, box, 0.0 * box + 1e-9, 5e-12, 5e-12)
    forged = dataclasses.replace(forged, unit=1e9 * certificate.unit, scale_range=[1e-9, 1.0])
    assert "unit: " in verify(forged, source, target).reason


@pytest.mark.parametrize("name", ["source_centre", "target_centre"])
def test_another_centre_is_refused(tmp_path, case, name):
    refused(tmp_path, case, name, **{name: getattr(case[0], name) + 1e-3})


def test_rounding_is_not_measured_by_the_value_of_a_far_pose(case):
    certificate, source, target = case
    theta = np.append(certificate.theta[:-1], 1e6)
    value = family_of(case).objective(theta)
    box = np.maximum(-certificate.start_lower, certificate.start_upper)
    forged = one_leaf(certificate, box, theta, value, 0.9e-9 * value)
    assert not verify(forged, source, target, n_samples=0).accepted


def test_a_huge_start_box_hides_no_gap():
    end, gap = np.full(2, 1e13), 4.0
    lower, upper = np.stack([-end, -end]), np.stack([end, end])
    upper[0, 0], lower[1, 0] = -gap, gap
    with pytest.raises(CertificateError, match="a gap"):
        check_cover(-end, end, lower, upper)


def test_a_local_optimum_passed_off_as_global_is_refused(tmp_path, case):
    """All entries agree with each other, but the objective is lower elsewhere."""
    certificate = case[0]
    family = family_of(case)
    theta = certificate.theta + 0.05
    value = family.objective(theta)
    assert value > certificate.upper_bound + certificate.gap_tol
    lower_bound = value - certificate.gap_tol
    bounds = np.maximum(certificate.leaf_bounds, lower_bound)
    claim = {"theta": theta, "upper_bound": value, "lower_bound": lower_bound}
    refused(tmp_path, case, "bound is false", leaf_bounds=bounds, **claim)


def test_inadmissible_leaves_must_be_so(tmp_path, case):
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


def test_too_many_pairs_for_plain_code_are_said_to_be(tmp_path, case, monkeypatch):
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


def test_an_effort_limit_ends_the_proof_with_a_refusal(tmp_path, case):
    certificate, source, target = case
    report = check(tmp_path, certificate, source, target, max_boxes=5)
    assert "could not be confirmed within 5 boxes" in report.reason


# --- what the claim rests on ------------------------------------------------------------------


@st.composite
def claims(draw):
    """A certificate of a search cut short, and one that claims more than the best known value."""
    model = draw(st.sampled_from(sorted(DIM)))
    seed = draw(st.integers(0, 2**32 - 1))
    generator = np.random.default_rng(seed)
    k = draw(st.integers(3, 6))
    source, target = clouds(model, n=k, extra=draw(st.integers(0, 2)), seed=seed)
    true = certify(source, target, k, model, bound="dc", nodes=draw(st.integers(1, 60)))
    family = family_of((true, source, target))
    while True:  # a worse pose passed off as the best
        step = 10.0 ** generator.uniform(-3, 0) * generator.standard_normal(len(true.theta))
        theta = true.theta + step
        value = family.objective(theta)
        if family.admissible(theta[None])[0] and value > true.upper_bound + 1e-6:
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
    """Whatever the leaves say of themselves; and the same cover carries the claim that is true."""
    true, false, source, target = claim
    for n_samples in (0, 100):
        report = verify(false, source, target, max_boxes=400, n_samples=n_samples)
        assert not report.accepted
        assert re.search("bound is false|could not be confirmed|inadmissible|no adm", report.reason)
    report = verify(true, source, target)
    assert report.accepted, report.reason


def test_a_bound_of_zero_needs_no_proof(monkeypatch):
    """However high the leaves' own bounds; but what is false among them is still refused."""
    source, target = clouds("translation3d", extra=1)
    certificate = certify(source, target, 10, "translation3d", bound="dc", nodes=300, tau=0.01)
    assert certificate.lower_bound == 0
    assert (certificate.leaf_bounds > 0).any()
    false = certificate.leaf_bounds.copy()
    false[false.argmax()] += 1e3

    def never(*_):
        pytest.fail("a bound is computed")

    for owner, name in (
        (FAMILIES["translation3d"], "nearest_bound"),
        (FAMILIES["translation3d"], "interval_bound"),
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


def test_a_lower_bound_of_zero_says_nothing_in_the_plane_too(rng):
    source = rng.random((12, 2))
    target = source + 1e-3 * rng.standard_normal((12, 2))
    found = register(source, target, n_inliers=12, model="similarity2d", certificate=True)
    assert found.success
    assert found.lower_bound == 0 < found.upper_bound
    report = verify(found.certificate, source, target)
    assert report.accepted, report.reason
    assert report.is_trivial


def test_the_check_says_what_was_proven(case):
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


# --- the parts of the proof -------------------------------------------------------------------


WITHOUT_THE_SEARCH = """
import sys, types
package = types.ModuleType("dcreg")
package.__path__ = ["dcreg"]  # its __init__, which imports everything, is not run
sys.modules["dcreg"] = package
for name in ("search", "bounds", "spaces", "kernels", "local", "modes", "problem", "registration"):
    sys.modules[f"dcreg.{name}"] = None  # importing it raises
import numpy as np
from dcreg.certificate import verify
report = verify(sys.argv[1], np.load(sys.argv[2]), np.load(sys.argv[3]))
print(report.accepted, report.reason)
assert not [name for name in sys.modules if name.startswith("numba")]
"""


def test_verification_runs_where_the_search_cannot_be_imported(tmp_path, case):
    certificate, source, target = case
    names = [tmp_path / name for name in ("certificate.npz", "source.npy", "target.npy")]
    write(names[0], certificate)
    np.save(names[1], source)
    np.save(names[2], target)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_THE_SEARCH, *map(str, names)],
        cwd=Path(__file__).parents[2], capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.split() == ["True"], done.stdout + done.stderr


def test_safe_start_box_holds_the_region_of_a_single_far_pair():
    """`region` projects the cloud on directions, and must not add to what the radii alone tell."""
    source = np.array([[1.0, 0.0], [0.1, 0.0], [0.0, -0.1]])
    clouds = source, -source, 1, (0.5, 1.5)
    lower, upper = FAMILIES["similarity2d"](*clouds).region()
    (start,) = Similarity2D(*clouds, stationary_box=False).roots()
    assert (start.lower <= lower + 1e-12).all()
    assert (start.upper >= upper - 1e-12).all()


@settings(max_examples=150)
@given(models_with_boxes(max_points=7), st.integers(0, 2**32 - 1))
def test_plain_bounds_hold_and_objectives_agree(case, seed):
    space, box = case
    name = "similarity2d" if box.dim == 4 else "translation3d"
    family = FAMILIES[name](space.source, space.target, space.n_inliers, (0.5, 1.5))
    thetas = np.vstack([box.sample(np.random.default_rng(seed), 20), box.vertices(), box.centre])
    values = np.array([family.objective(theta) for theta in thetas])
    np.testing.assert_allclose(values, [space.objective(t)[0] for t in thetas], atol=1e-9)
    assert (family.least(thetas) <= values + 1e-9).all()
    for bound in (
        family.nearest_bound,
        family.interval_bound,
        Proof(family, 0.0, 1).tangent_bound,
    ):
        for needed in (np.inf, 1.5 * values.min(), 0.5 * values.min()):
            found = bound(box.lower[None], box.upper[None], needed)[0]
            assert found <= values.min() + 1e-9
    (start,) = space.roots()
    region_lower, region_upper = family.region()
    assert (start.lower <= region_lower + 1e-9).all()
    assert (start.upper >= region_upper - 1e-9).all()


def test_a_proof_over_norms_solves_no_assignments_and_hardly_divides_leaves():
    """Some norms stay without a partner; the lower bound is above 0, so that every leaf needs a proof."""
    source, target = clouds("translation3d", n=20, extra=3, seed=3)
    certificate = certify(source, target, 20, "translation3d", bound="tight", tau=0.0125)
    assert certificate.status == "optimal"
    assert certificate.lower_bound > 0
    report = verify(certificate, source, target)
    assert report.accepted, report.reason
    assert report.n_leaves > 1000
    assert report.n_boxes < 1.02 * report.n_leaves
    assert report.n_assignments == 1  # of the stated optimum


@pytest.mark.parametrize("n", [5, 30, 80])
def test_prices_make_the_dual_as_high_as_the_assignment(n):
    """However long the paths that they are lengths of: pairs one after the other along a line."""
    places = np.arange(n, dtype=float)
    random = np.random.default_rng(n).random((n, n))
    for cost in (np.abs(places[:, None] - places - 1.0) ** 1.5, random):
        wide, columns = cheapest_pairs(cost, n - 1)
        prices = prices_of(wide, columns)
        dual = (wide + prices).min(axis=1).sum() - prices[columns].sum()
        assert dual == pytest.approx(wide[np.arange(n), columns].sum(), abs=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.005, 0.2), st.floats(1.01, 3.0))
def test_curvature_leaves_matchings_that_count_concave(seed, size, share):
    """Of a matching whose sum falls below `needed` somewhere in the box, less the quadratic."""
    generator = np.random.default_rng(seed)
    source, target = clouds("translation3d", n=10, extra=2, seed=seed)
    family = FAMILIES["translation3d"](source, target, 10, (1.0, 1.0))
    centre = 0.3 * generator.standard_normal(3)
    lower = centre - size * generator.random(3)
    upper = centre + size * generator.random(3)
    within = lower + generator.random((3, 3)) * (upper - lower)
    wide, columns = cheapest_pairs(family.costs(within[0]), 10)
    rows = np.flatnonzero(columns < len(target))
    value = wide[np.arange(len(wide)), columns].sum()
    (matrix,) = family.curvature(lower[None], upper[None], share * value)

    def rest(theta):
        residuals = np.linalg.norm(source[rows] + theta, axis=1) - family.norms[columns[rows]]
        return (residuals**2).sum() - theta @ matrix @ theta

    _, a, b = within
    assert rest(0.5 * (a + b)) >= 0.5 * (rest(a) + rest(b)) - 1e-12


def test_curvature_is_less_than_that_of_all_pairs_in_small_boxes():
    source, target = clouds("translation3d", n=30, extra=2)
    family = FAMILIES["translation3d"](source, target, 30, (1.0, 1.0))
    theta = np.array([[0.02, -0.03, 0.05]])
    (near_any,) = family.curvature(theta - 0.01, theta + 0.01, np.inf)
    np.testing.assert_array_equal(near_any, 30 * np.eye(3))
    (near_optimum,) = family.curvature(theta - 0.01, theta + 0.01, 0.1)
    assert np.linalg.eigvalsh(near_optimum).max() < 30


@st.composite
def tilings(draw):
    """Leaves of a random bisection tree; one axis may be flat."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lower, upper = -generator.random((1, 3)), generator.random((1, 3))
    if draw(st.booleans()):
        lower[0, 1] = upper[0, 1] = 0.0
    start = lower[0], upper[0]
    for _ in range(draw(st.integers(1, 40))):
        pick = generator.integers(len(lower))
        halves = LongestEdge(generator.random(3) + 0.1)(lower[[pick]], upper[[pick]])
        lower = np.vstack([np.delete(lower, pick, axis=0), halves[0]])
        upper = np.vstack([np.delete(upper, pick, axis=0), halves[1]])
    order = generator.permutation(len(lower))
    return start, lower[order], upper[order], generator


@given(tilings())
def test_tilings_are_recognised_and_broken_ones_refused(tiling):
    start, lower, upper, generator = tiling
    check_cover(*start, lower, upper)
    check_cover(*start, lower - 1e-15, upper)  # rounding
    leaf = generator.integers(len(lower))
    if len(lower) > 1:
        with pytest.raises(CertificateError, match="gap"):
            check_cover(*start, np.delete(lower, leaf, axis=0), np.delete(upper, leaf, axis=0))
    with pytest.raises(CertificateError, match="overlap"):
        check_cover(*start, np.vstack([lower, lower[leaf]]), np.vstack([upper, upper[leaf]]))
    axis = np.argmax(upper[leaf] - lower[leaf])
    for step in (0.3, -0.3):
        moved = upper.copy()
        moved[leaf, axis] += step * (upper - lower)[leaf, axis]
        with pytest.raises(CertificateError, match="leaves: "):
            check_cover(*start, lower, moved)
