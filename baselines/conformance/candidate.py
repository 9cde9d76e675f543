"""A method to check, the problems that it receives, and how a broken rule is reported."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines._shared.poses import homogeneous
from baselines.contract import Baseline, Card, Instance, Limits, ModelName, Solution
from dcreg.problem import apply_pose

# A search that exceeds this number of nodes would also exceed the time limit.
LIMITS = Limits(time_s=8.0, nodes=3500)
MODELS: tuple[ModelName, ...] = ("similarity2d", "rigid3d")


class BrokenRuleError(Exception):
    """A method breaks a rule; the message says how, and what to do."""


class NotCheckedError(Exception):
    """A rule cannot be checked here, for instance because the method is not installed."""


def require(condition: object, message: str) -> None:
    """Raise unless the condition is true.

    Raises
    ------
    BrokenRuleError
    """
    if not condition:
        raise BrokenRuleError(message)


class Watched(Instance):
    """An instance that remembers which of its fields were read."""

    def __getattribute__(self, name: str) -> Any:
        if not name.startswith("_"):
            self.__dict__.setdefault("_read", set()).add(name)
        return super().__getattribute__(name)


@dataclass
class Candidate:
    """A method to check; one run per model is kept for the rules that only read it.

    ``root`` is the folder that contains the folder of the method; None: as the registry finds it.
    """

    name: str
    root: Path | None = None
    runs: dict[str, tuple[Watched, Solution]] = field(default_factory=dict)

    @property
    def card(self) -> Card:
        return registry.read_card(self.name, self.root)

    def load(self, **options: Any) -> Baseline:
        return registry.load(self.name, root=self.root, **options)

    def runnable(self) -> Baseline:
        """Return the method.

        Raises
        ------
        NotCheckedError
            It is not installed.
        """
        method = self.load()
        if (reason := method.available()) is not None:
            raise NotCheckedError(reason)
        return method

    def solved(self, model: str) -> Solution:
        """Return the solution of the easy instance."""
        return self._run(model)[1]

    def given(self, model: str) -> Watched:
        """Return the instance that the method received."""
        return self._run(model)[0]

    def _run(self, model: str) -> tuple[Watched, Solution]:
        if model not in self.runs:
            method = self.runnable()
            method.warm_up(easy_instance(model))
            instance = Watched(**vars(easy_instance(model)))
            for points in (instance.source, instance.target):
                points.setflags(write=False)
            instance.__dict__.pop("_read", None)
            self.runs[model] = instance, method.solve(instance, LIMITS)
        return self.runs[model]


def easy_instance(model: str) -> Instance:
    """Return a small asymmetric shape, slightly moved, with a few points missing from the target."""
    generator = np.random.default_rng(7)
    if model == "similarity2d":
        angle = np.linspace(0, 2 * np.pi, 26)[:-1]  # a fish-like contour
        body = np.column_stack([np.cos(angle) + 0.4 * np.cos(2 * angle), 0.6 * np.sin(angle)])
        source = 0.4 * body + 0.1 * np.column_stack([np.sin(3 * angle), np.cos(5 * angle)])
        c, s = np.cos(0.3), np.sin(0.3)
        truth = homogeneous(1.1, np.array([[c, -s], [s, c]]), np.array([0.1, -0.05]))
        scale_range = (0.5, 1.5)
    else:
        # A bent, lopsided shell: a surface, since some methods estimate normals or covariances.
        shell = generator.standard_normal((42, 3))
        shell /= np.linalg.norm(shell, axis=1, keepdims=True)
        source = shell * [0.6, 0.4, 0.3] + 0.3 * shell[:, [0]] ** 2 * [0.0, 0.4, 1.0]
        rotation = Rotation.from_rotvec([0.1, -0.15, 0.1]).as_matrix()
        truth = homogeneous(1.0, rotation, np.array([0.05, 0.02, -0.04]))
        scale_range = (1.0, 1.0)
    target = generator.permutation(apply_pose(truth, source))[2:]
    target += 0.002 * generator.standard_normal(target.shape)
    return Instance(
        instance_id=f"easy-{model}",
        source=source,
        target=target,
        model=MODELS[model == "rigid3d"],
        n_inliers=len(target),
        scale_range=scale_range,
        noise_bound=0.02,
        seed=11,
    )


def hard_instance(model: str) -> Instance:
    """Return the easy instance with many points displaced, which no search solves at once."""
    easy, generator = easy_instance(model), np.random.default_rng(3)
    target = easy.target.copy()
    moved = generator.permutation(len(target))[::2]
    target[moved] = generator.permutation(target[moved] * [1.0, -0.6, 0.8][: easy.dim])
    return replace(easy, target=target, n_inliers=len(target) // 2)
