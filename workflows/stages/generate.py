"""Makes the instances of a chunk, and apart from them their truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from baselines.contract import Instance
from data import registry
from data.contract import RawInstance
from data.sampling import transform
from workflows import CHECKOUT
from workflows.disturb import make_instance
from workflows.hashing import digest_files
from workflows.instances import Problem, Truth, with_oracle, write_problems, write_truths
from workflows.stages.plan import Chunk, InstanceSpec, Plan
from workflows.records import replacing

# Least inlier threshold told to methods, as a share of the target's longest side. A noise-free
# instance has residual 0, with which no thresholding method can work.
LEAST_NOISE_BOUND = 0.01


def generate(chunk: Chunk, instances_path: Path, truth_path: Path) -> None:
    """Write the two files of a chunk."""
    made = [(spec, _raw(spec)) for spec in chunk.instances]
    write_problems(instances_path, (problem_of(spec, raw) for spec, raw in made))
    write_truths(truth_path, (truth_of(spec, raw) for spec, raw in made))


def fetch(plan: Plan, dataset_name: str, out: Path) -> None:
    """Bring in all files of a dataset that the plan needs, and note the terms they come on.

    Loading an instance fetches and verifies what it needs and nothing else: a whole benchmark need
    not be downloaded for a part of it.
    """
    specs = [
        spec for chunk in plan.chunks for spec in chunk.instances if spec.dataset == dataset_name
    ]
    card = registry.dataset(dataset_name).card
    if card.files:
        for spec in specs:
            _raw(spec)
    note = {
        "dataset": dataset_name,
        "instances": len(specs),
        "licence": card.licence,
        "citation": card.citation,
    }
    with replacing(out) as part:
        part.write_text(json.dumps(note, indent=1), encoding="utf-8")


def problem_of(spec: InstanceSpec, raw: RawInstance) -> Problem:
    """What may be known of an instance: points, and the two priors that all methods share."""
    return Problem(
        instance_id=spec.instance_id,
        model=spec.model,
        source=np.ascontiguousarray(raw.source, dtype=float),
        target=np.ascontiguousarray(raw.target, dtype=float),
        scale_range=raw.scale_range,
        n_inliers_prior=len(raw.pairs),
        noise_bound=noise_bound(raw),
    )


def instance_of(
    spec: InstanceSpec,
    n_inliers_ratio: float,
    experiment_seed: int,
    oracle_outliers: float | None = None,
) -> Instance:
    """Exactly what a worker is given for this spec; oracle pairs only where they are asked for."""
    raw = _raw(spec)
    instance = problem_of(spec, raw).for_solver(n_inliers_ratio, experiment_seed)
    if oracle_outliers is None:
        return instance
    return with_oracle(instance, truth_of(spec, raw), oracle_outliers)


def truth_of(spec: InstanceSpec, raw: RawInstance) -> Truth:
    return Truth(spec.instance_id, raw.T_true, raw.pairs)


def noise_bound(raw: RawInstance) -> float:
    """Root mean square residual of the true pairs at the true pose, but not below a floor."""
    source, target = raw.source[raw.pairs[:, 0]], raw.target[raw.pairs[:, 1]]
    residuals = transform(raw.T_true, source) - target
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean()))
    return max(rms, LEAST_NOISE_BOUND * float(np.ptp(raw.target, axis=0).max()))


def sources_digest(datasets: list[str]) -> str:
    """Hash of all code and cards that decide the content of instances from these datasets."""
    shared = ["data/contract.py", "data/loaders.py", "data/sampling.py", "workflows/disturb.py"]
    own = [f"data/{name}" for name in datasets]
    return digest_files(
        CHECKOUT, [*shared, *own, "workflows/stages/generate.py", "workflows/instances.py"]
    )


def _raw(spec: InstanceSpec) -> RawInstance:
    dataset = registry.dataset(spec.dataset)
    return make_instance(dataset, spec.shape, spec.test, spec.level, spec.trial, spec.n_points)
