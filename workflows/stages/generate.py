"""Make the instances of a chunk and, in a separate file, their ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from baselines.contract import NOISE_FACTOR, Instance
from baselines.dependencies import files_behind
from data import registry
from data.contract import DataError, RawInstance
from dcreg.problem import apply_pose
from workflows import CHECKOUT
from workflows.disturb import make_instance
from workflows.hashing import digest, digest_paths
from workflows.instances import Problem, Truth, with_oracle, write_problems, write_truths

if TYPE_CHECKING:
    from workflows.stages.plan import Chunk, InstanceSpec

# Minimum inlier threshold given to methods, as a share of the target's longest side: without noise the
# residual is 0, and no method that thresholds residuals could work.
MIN_NOISE_BOUND = 0.01


def generate(chunk: Chunk, instances_path: Path, truth_path: Path) -> None:
    """Write the two files of a chunk."""
    made = [(spec, raw_instance(spec)) for spec in chunk.instances]
    problems = [problem_of(spec, raw) for spec, raw in made]
    for problem, (spec, raw) in zip(problems, made, strict=True):
        check_cube(spec, problem, raw.T_true)
    write_problems(instances_path, problems)
    write_truths(truth_path, (truth_of(spec, raw) for spec, raw in made))


def problem_of(spec: InstanceSpec, raw: RawInstance) -> Problem:
    """Return what solvers may receive: points, and the two priors that all methods share."""
    from baselines._shared.front_ends import shared_matches  # loads Numba

    return Problem(
        instance_id=spec.instance_id,
        model=spec.model,
        source=np.ascontiguousarray(raw.source, dtype=float),
        target=np.ascontiguousarray(raw.target, dtype=float),
        scale_range=raw.scale_range,
        n_inliers_prior=len(raw.pairs) if raw.n_inliers is None else raw.n_inliers,
        noise_bound=raw.noise_bound or noise_bound(raw),
        matches=(
            shared_matches(raw.source, raw.target, raw.match_radii, raw.viewpoint)
            if raw.match_radii
            else {}
        ),
    )


def check_cube(spec: InstanceSpec, problem: Problem, T_true: np.ndarray) -> None:
    """Refuse an instance whose reference pose lies outside Go-ICP's cube of all translations.

    Raises
    ------
    DataError
    """
    if problem.model != "rigid3d":
        return
    from baselines.goicp.adapter import contains_translation  # loads Numba

    if not contains_translation(problem.for_solver(1.0, 0), T_true, None):
        raise DataError(
            f"{spec.dataset} {spec.shape} {spec.test} {spec.level:g}, trial {spec.trial}: the cube of "
            "translations of goicp-all excludes the reference pose; correct the pose or the pairs"
        )


def instance_of(
    spec: InstanceSpec,
    n_inliers_ratio: float,
    experiment_seed: int,
    oracle_outliers: float | None = None,
    n_points: int | None = None,
) -> Instance:
    """Return exactly what a worker receives for this spec; oracle pairs only if requested."""
    raw = raw_instance(spec)
    instance = problem_of(spec, raw).for_solver(n_inliers_ratio, experiment_seed, n_points)
    if oracle_outliers is None:
        return instance
    return with_oracle(instance, truth_of(spec, raw), oracle_outliers)


def truth_of(spec: InstanceSpec, raw: RawInstance) -> Truth:
    marks = None if raw.marks is None else np.hstack(raw.marks)
    return Truth(spec.instance_id, raw.T_true, raw.pairs, marks)


def noise_bound(raw: RawInstance) -> float:
    """Return `NOISE_FACTOR` times the RMS residual at the reference pose, or a minimum."""
    source, target = raw.judged
    residuals = apply_pose(raw.T_true, source) - target
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean()))
    return max(NOISE_FACTOR * rms, MIN_NOISE_BOUND * float(np.ptp(raw.target, axis=0).max()))


def sources_digest(datasets: Iterable[str]) -> str:
    """Hash all code and cards that determine the instances of these datasets."""
    own = [path for name in datasets for path in registry.files_of(name)]
    behind = files_behind(
        [Path(__file__), *own], CHECKOUT, ("baselines", "data", "dcreg", "workflows")
    )
    local = [path for name in datasets for path in registry.dataset(name).local_files()]
    states = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in local]
    return digest([digest_paths(behind, CHECKOUT), states])


def fetched_digest(datasets: Iterable[str]) -> str:
    """Hash the folders of these datasets, whose cards list their files."""
    return digest_paths([path for name in datasets for path in registry.files_of(name)], CHECKOUT)


def raw_instance(spec: InstanceSpec) -> RawInstance:
    """Return the instance with its ground truth; fetches and verifies only the files that it needs."""
    dataset = registry.dataset(spec.dataset)
    return make_instance(dataset, spec.shape, spec.test, spec.level, spec.trial, spec.n_points)
