"""Small problems with a question, each made by its number alone, and the answer by all matchings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.problem import Problem, apply_pose
from tests.oracles.matchings import matchings

MODELS = ("similarity2d", "rigid3d")
KINDS = ("general", "noisy copy", "symmetric", "collinear")
RANGES_2D = ({"max_angle": 40.0}, {"max_angle": 0.0}, {"max_angle": 100.0})
# Ranges for which `PoseRange.fit` is exact: its docstring says where it is not.
RANGES_3D = (
    {"axis": (0.0, 0.0, 1.0)},
    {"axis": (1.0, 2.0, -1.0), "max_angle": 50.0},
    {"axis": (0.0, 1.0, 0.0), "max_angle": 120.0},
    {"max_angle": 0.0},
    {"max_angle": 0.0, "max_translation": 0.4},
)
TIME_LIMIT = 2.0


@dataclass(frozen=True)
class Small:
    """A problem so small that all its matchings can be tried."""

    number: int
    kind: str
    problem: Problem

    @property
    def keywords(self) -> dict[str, Any]:
        """What `register`, `certify` and, without a range, `alternatives` share."""
        p = self.problem
        ranges = {} if p.pose_range is None else {"pose_range": p.pose_range}
        return {
            "n_inliers": p.n_inliers, "model": p.model, "time_limit": TIME_LIMIT,
            "scale_range": p.scale_range, **ranges,
        }  # fmt: skip

    def with_n_inliers(self, count: int) -> Small:
        """Return the problem for another number of pairs."""
        return replace(self, problem=self.problem.with_n_inliers(count))

    def fits(self) -> list[tuple[float, np.ndarray]]:
        """Return the best pose of every matching with its objective for this matching."""
        p = self.problem
        found = []
        for rows, columns in matchings(len(p.source), len(p.target), p.n_inliers):
            x, y = p.source[rows], p.target[columns]
            T = p.fit(x, y)
            found.append((float(((apply_pose(T, x) - y) ** 2).sum()), T))
        return found

    def rounding(self) -> float:
        """Return an objective that is 0 up to rounding."""
        return 1e-9 * (1.0 + float((self.problem.target**2).sum()))

    def __str__(self) -> str:
        p = self.problem
        return f"#{self.number} {p.model} {self.kind} n={len(p.source)} m={len(p.target)} k={p.n_inliers}"


def small(number: int, *, with_range: bool = False) -> Small:
    """Return the problem of a number."""
    rng = np.random.default_rng([7, number])
    model = MODELS[number % 3 % 2]  # two of three in 2D, where searches are fast
    d = 2 if model == "similarity2d" else 3
    kind = KINDS[int(rng.integers(len(KINDS)))]
    n, m = (int(count) for count in rng.integers(3, 6, size=2))
    source = rng.standard_normal((n, d))
    if kind == "collinear":
        source = rng.standard_normal((n, 1)) * np.ones(d) + 0.01 * source
    if kind == "symmetric":
        turns = 2.0 * np.pi * np.arange(n) / n
        source = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(n)])[:, :d]
    target = rng.standard_normal((m, d))
    if kind != "general":
        common = min(n, m)
        turn = _rotation(rng, d)
        target[:common] = source[:common] @ turn.T + 0.3 * rng.standard_normal(d)
        target[:common] += 0.02 * rng.standard_normal((common, d))
        target = target[rng.permutation(m)]
    k = int(rng.integers(min(d, n, m), min(n, m) + 1))
    scale_range = (0.5, 1.5) if d == 2 and rng.random() < 0.5 else (1.0, 1.0)
    pose_range = None
    if with_range:
        ranges = RANGES_2D if d == 2 else RANGES_3D
        pose_range = dcreg.PoseRange(
            **ranges[int(rng.integers(len(ranges)))], around=_around(rng, d)
        )
    return Small(
        number, kind, Problem(source, target, k, model, scale_range, pose_range=pose_range)
    )


def _around(rng: np.random.Generator, d: int) -> np.ndarray:
    T = np.eye(d + 1)
    T[:d, :d], T[:d, d] = _rotation(rng, d), 0.3 * rng.standard_normal(d)
    return T


def _rotation(rng: np.random.Generator, d: int) -> np.ndarray:
    if d == 3:
        return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
