"""Packed files: the instances, and separately their ground truth, which no solver receives."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from baselines.contract import Instance
from data.sampling import farthest_points
from workflows.hashing import digest_arrays, seed
from workflows.integrity import sealed_file


@dataclass(frozen=True)
class Problem:
    """An instance as the harness stores it; `for_solver` returns what a worker receives.

    ``n_inliers_prior`` is the true number of pairs, or the number that the dataset prescribes. As in the
    paper, the solver receives a stated ratio of it as n_inliers. The only other value that derives from
    the ground truth is ``noise_bound``, the same for all methods. ``matches`` are the putative pairs that
    all methods share, if any.
    """

    instance_id: str
    model: str
    source: np.ndarray
    target: np.ndarray
    scale_range: tuple[float, float]
    n_inliers_prior: int
    noise_bound: float
    matches: dict[str, np.ndarray] = field(default_factory=dict)

    def lacks_points(self, n_inliers_ratio: float) -> str:
        """Return why the clouds are too small for this share of the pairs; empty if they are not."""
        most, wanted = (
            min(len(self.source), len(self.target)),
            n_inliers_ratio * self.n_inliers_prior,
        )
        if int(wanted) <= most:  # half a pair too many is rounding
            return ""
        return (
            f"n_inliers: {n_inliers_ratio:g} × {self.n_inliers_prior} pairs exceed the {most} points of "
            "the smaller cloud"
        )

    def for_solver(
        self, n_inliers_ratio: float, experiment_seed: int, n_points: int | None = None
    ) -> Instance:
        """Return the input of a solver; with `n_points`, by farthest-point sampling of each cloud."""
        source, target, matches = self.source, self.target, self.matches
        whole = min(len(source), len(target))
        if n_points is not None:
            source, target = (
                cloud[farthest_points(cloud, min(n_points, len(cloud)))]
                for cloud in (source, target)
            )
            matches = {}
        most = min(len(source), len(target))
        n_inliers = min(most, max(1, round(n_inliers_ratio * self.n_inliers_prior * most / whole)))
        return Instance(
            instance_id=self.instance_id,
            source=source,
            target=target,
            model=self.model,  # type: ignore[arg-type]
            n_inliers=n_inliers,
            scale_range=self.scale_range,
            noise_bound=self.noise_bound,
            seed=seed("solver", experiment_seed, self.instance_id),
            matches=matches,
        )


@dataclass(frozen=True)
class Truth:
    """What only the evaluation receives: the pose and the true pairs (rows of source and target).

    ``marks``: (k, 2 d) corresponding points of both clouds that replace the pairs in the evaluation.
    """

    instance_id: str
    T_true: np.ndarray
    pairs: np.ndarray
    marks: np.ndarray | None = None


def with_oracle(instance: Instance, truth: Truth, outliers: float) -> Instance:
    """Add true and random pairs, unmarked, for methods with the oracle front end."""
    from baselines._shared.front_ends import oracle_pairs  # loads Numba, which a plan does not need

    n, m = len(instance.source), len(instance.target)
    draw = seed("oracle", instance.instance_id)
    pairs = oracle_pairs(truth.pairs, n, m, outliers, draw)
    return replace(instance, oracle_pairs=pairs)


def content_digest(instance: Instance) -> str:
    """Hash everything in an instance that a solver receives, up to rounding."""
    whole = np.array([instance.n_inliers, instance.seed])
    numbers = whole, np.array(instance.scale_range), np.array([instance.noise_bound])
    pairs = () if instance.oracle_pairs is None else (instance.oracle_pairs,)
    shared = (instance.matches[name] for name in sorted(instance.matches))
    return digest_arrays(instance.source, instance.target, *numbers, *pairs, *shared)


def write_problems(path: Path, problems: Iterable[Problem]) -> None:
    from baselines._shared.front_ends import SHARED

    problems = list(problems)
    path.parent.mkdir(parents=True, exist_ok=True)
    with sealed_file(path) as part, part.open("wb") as stream:
        np.savez_compressed(
            stream,
            instance_id=[p.instance_id for p in problems],
            model=[p.model for p in problems],
            scale_range=[p.scale_range for p in problems],
            n_inliers_prior=[p.n_inliers_prior for p in problems],
            noise_bound=[p.noise_bound for p in problems],
            **_packed("source", [p.source for p in problems]),
            **_packed("target", [p.target for p in problems]),
            **{
                key: array
                for name in SHARED
                for key, array in _packed(name, [_matches(p, name) for p in problems]).items()
            },
        )


def _matches(problem: Problem, name: str) -> np.ndarray:
    return problem.matches.get(name, np.empty((0, 2))).astype(np.int32)


def read_problems(path: Path) -> list[Problem]:
    from baselines._shared.front_ends import SHARED

    with np.load(path, allow_pickle=False) as archive:
        file = dict(archive)
    matches = {name: _unpacked(name, file) for name in SHARED}
    return [
        Problem(
            instance_id=str(file["instance_id"][i]),
            model=str(file["model"][i]),
            source=source,
            target=target,
            scale_range=(float(file["scale_range"][i, 0]), float(file["scale_range"][i, 1])),
            n_inliers_prior=int(file["n_inliers_prior"][i]),
            noise_bound=float(file["noise_bound"][i]),
            matches={name: lists[i] for name, lists in matches.items() if len(lists[i])},
        )
        for i, (source, target) in enumerate(
            zip(_unpacked("source", file), _unpacked("target", file), strict=True)
        )
    ]


def write_truths(path: Path, truths: Iterable[Truth]) -> None:
    truths = list(truths)
    path.parent.mkdir(parents=True, exist_ok=True)
    with sealed_file(path) as part, part.open("wb") as stream:
        np.savez_compressed(
            stream,
            instance_id=[t.instance_id for t in truths],
            T_true=[t.T_true for t in truths],
            **_packed("pairs", [t.pairs for t in truths]),
            **_packed("marks", [_no_marks(t) if t.marks is None else t.marks for t in truths]),
        )


def read_truths(path: Path) -> dict[str, Truth]:
    with np.load(path, allow_pickle=False) as archive:
        file = dict(archive)
    names = [str(name) for name in file["instance_id"]]
    parts = file["T_true"], _unpacked("pairs", file), _unpacked("marks", file)
    return {
        name: Truth(name, T_true, pairs, marks if len(marks) else None)
        for name, T_true, pairs, marks in zip(names, *parts, strict=True)
    }


def _no_marks(truth: Truth) -> np.ndarray:
    return np.empty((0, 2 * (truth.T_true.shape[0] - 1)))


def _packed(name: str, arrays: list[np.ndarray]) -> dict[str, Any]:
    """Return arrays of different lengths as one, with the row at which each ends."""
    return {name: np.concatenate(arrays), f"{name}_ends": np.cumsum([len(a) for a in arrays])}


def _unpacked(name: str, file: dict[str, np.ndarray]) -> list[np.ndarray]:
    return np.split(file[name], file[f"{name}_ends"][:-1])
