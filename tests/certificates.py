"""Certificates of small searches with the library's own parts, for the tests of their check."""

import dataclasses
from functools import cache

import numpy as np

from dcreg.certificate import write
from dcreg.certificate.record import record
from dcreg.certificate.verification import verify
from dcreg.families.registry import make_bound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import Frame, Problem
from dcreg.problem.geometry import apply_pose, fit_pose
from dcreg.search import Budget, Tolerance, minimise
from tests.problems import register

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
        Translation3D(*points, stationary_box=reduced)
        if model == "translation3d"
        else Similarity2D(*points, problem.scale_range, stationary_box=reduced)
    )
    theta, value, _ = space.refine(space.identity)
    searched, gap_tol = make_bound(bound, space), n_inliers * tau**2
    found = minimise(
        space, searched, Budget(nodes=nodes),
        tolerance=Tolerance(abs=gap_tol, exact=1e-12 * n_inliers), start=(theta, value),
        keep_leaves=True,
    )  # fmt: skip
    root, names = searched.roots[0], {"model": model, "mode": "paper", "bound": bound}
    return record(found, root, problem, frame, gap_tol, **names)


@cache
def made_case(model):
    """A certificate of a closed search, with its clouds."""
    source, target = clouds(model, extra=1)
    tau = {"similarity2d": 0.06, "translation3d": 0.035}[model]
    certificate = certify(source, target, 10, model, bound="dc", tau=tau)
    assert certificate.status == "optimal"
    assert len(certificate.leaf_bounds) > 20
    assert certificate.lower_bound > 0
    return certificate, source, target


@cache
def rigid_case(extra=0, **options):
    """A certificate of rigid 3D poses, with its clouds; with outliers, the source is the larger one."""
    source, target = clouds("translation3d", n=8, extra=extra)
    pose = np.linalg.inv(fit_pose(source[:8], target[:8], (1.0, 1.0)))
    source[:8] += 0.9 * (apply_pose(pose, target[:8]) - source[:8])  # a tenth of the noise
    target = target[: 8 + max(0, extra - 1)]
    result = register(
        source, target, n_inliers=8, model="rigid3d", certificate=True, prove=True, **options
    )
    return result.certificate, source, target


def check(tmp_path, certificate, source, target, **options):
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    return verify(path, source, target, **options)


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
