"""Small problems with a question, each made by its number alone, and the answer by all matchings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.problem import Problem, apply_pose
from dcreg.problem.geometry import fit_pose
from tests.oracles.matchings import matchings
from tests.questions.ranges import improved

MODELS = ("similarity2d", "rigid3d")
KINDS = ("general", "noisy copy", "symmetric", "collinear")
RANGES_2D = (
    {"max_angle": 40.0},
    {"max_angle": 0.0},
    {"max_angle": 100.0},
    {"max_translation": 0.3},
    {"max_angle": 60.0, "max_translation": 0.4},
)
RANGES_3D = (
    {"axis": (0.0, 0.0, 1.0)},
    {"axis": (1.0, 2.0, -1.0), "max_angle": 50.0},
    {"axis": (0.0, 1.0, 0.0), "max_angle": 120.0},
    {"max_angle": 0.0},
    {"max_angle": 0.0, "max_translation": 0.4},
    {"max_angle": 70.0},
    {"max_translation": 0.4},
    {"max_angle": 40.0, "max_translation": 0.5},
    {"axis": (1.0, 0.0, 1.0), "max_angle": 80.0, "max_translation": 0.3},
)
TIME_LIMIT = 2.0
# What a problem can have in addition; each of them excludes the others.
VARIANTS = ("range", "similarity3d", "weights", "candidates", "attributes")
Rows = list[int] | np.ndarray


@dataclass(frozen=True)
class Small:
    """A problem so small that all its matchings can be tried."""

    number: int
    kind: str
    problem: Problem
    weights: dcreg.PointWeights | None = None
    attributes: dcreg.Attributes | None = None

    @property
    def keywords(self) -> dict[str, Any]:
        """What `register`, `certify` and, without a range, `alternatives` share."""
        p = self.problem
        given = {
            "pose_range": p.pose_range, "candidates": p.candidates, "weights": self.weights,
            "attributes": self.attributes,
        }  # fmt: skip
        return {
            "n_inliers": p.n_inliers, "model": p.model, "time_limit": TIME_LIMIT,
            "scale_range": p.scale_range,
            **{name: value for name, value in given.items() if value is not None},
        }  # fmt: skip

    def with_n_inliers(self, count: int) -> Small:
        """Return the problem for another number of pairs."""
        return replace(self, problem=self.problem.with_n_inliers(count))

    def fits(self) -> list[tuple[float, np.ndarray]]:
        """Return a pose for every feasible matching, with its objective for this matching.

        It is the best pose, except where `PoseRange.fit` is not exact: there, a matching whose best pose
        of all poses is worse than the optimum of the range keeps the pose of `PoseRange.fit`.
        """
        p = self.problem
        found, best = [], np.inf
        for free_value, rows, columns in self._matchings():
            factors = () if p.weights is None else (p.weights.factors[rows, columns],)
            x, y = p.source[rows], p.target[columns]
            T = p.fit(x, y, *factors)
            if p.pose_range is not None and free_value < best:
                T = improved(p, T, x, y)
            found.append((self.cost(T, rows, columns), T))
            best = min(best, found[-1][0])
        return found

    def _matchings(self) -> list[tuple[float, Rows, Rows]]:
        """Return rows and columns of the feasible matchings.

        With a range of poses, they are ordered by their objective without the range.
        """
        p, found = self.problem, []
        for rows, columns in matchings(len(p.source), len(p.target), p.n_inliers):
            if p.candidates is not None and not p.candidates[rows, columns].all():
                continue
            value = 0.0
            if p.pose_range is not None:
                T = fit_pose(p.source[rows], p.target[columns], p.scale_range)
                value = self.cost(T, rows, columns)
            found.append((value, rows, columns))
        return sorted(found, key=lambda one: one[0])

    def cost(self, T: np.ndarray, rows: Rows, columns: Rows) -> float:
        """Return the sum of the squared residuals of pairs, or of their weighted costs."""
        p = self.problem
        costs = ((apply_pose(T, p.source[rows]) - p.target[columns]) ** 2).sum(axis=1)
        if p.weights is not None:
            costs = p.weights.factors[rows, columns] * costs + p.weights.extra[rows, columns]
        return float(costs.sum())

    def rounding(self) -> float:
        """Return an objective that is 0 up to rounding."""
        return 1e-9 * (1.0 + float((self.problem.target**2).sum()))

    def __str__(self) -> str:
        p = self.problem
        return f"#{self.number} {p.model} {self.kind} n={len(p.source)} m={len(p.target)} k={p.n_inliers}"


def small(number: int, variant: str = "") -> Small:
    """Return the problem of a number, in one of the `VARIANTS` if one is given."""
    rng = np.random.default_rng([7, number])
    model = MODELS[number % 3 % 2]  # two of three in 2D, where searches are fast
    if variant == "similarity3d":
        model = variant
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
        turn = rotation(rng, d)
        target[:common] = source[:common] @ turn.T + 0.3 * rng.standard_normal(d)
        target[:common] += 0.02 * rng.standard_normal((common, d))
        target = target[rng.permutation(m)]
    k = int(rng.integers(min(d, n, m), min(n, m) + 1))
    has_scale = model != "rigid3d" and rng.random() < 0.5
    scale_range = (0.5, 1.5) if has_scale else (1.0, 1.0)
    pose_range = candidates = weights = attributes = None
    if variant == "range":
        ranges = RANGES_2D if d == 2 else RANGES_3D
        pose_range = dcreg.PoseRange(
            **ranges[int(rng.integers(len(ranges)))], around=_around(rng, d)
        )
    if variant == "candidates":
        candidates = rng.random((n, m)) < 0.6
        candidates[rng.permutation(n)[:k], rng.permutation(m)[:k]] = True  # one feasible matching
    if variant == "weights" or (variant == "attributes" and rng.random() < 0.3):
        weights = _weights(rng, n, m, k)
    if variant == "attributes":
        scale = float(rng.uniform(0.1, 1.0))
        attributes = dcreg.Attributes(rng.random((n, 2)), rng.random((m, 2)), scale)
    problem = Problem(source, target, k, model, scale_range, candidates, pose_range, weights)
    return Small(number, kind, problem.with_attributes(attributes), weights, attributes)


def _weights(rng: np.random.Generator, n: int, m: int, k: int) -> dcreg.PointWeights:
    """Return weights of the source, or of both clouds; with a distance where one is required."""
    source = rng.uniform(0.1, 1.0, n)
    if k == n and rng.random() < 0.5:
        return dcreg.PointWeights(source=source)
    target = rng.uniform(0.1, 1.0, m) if rng.random() < 0.5 else None
    return dcreg.PointWeights(source=source, target=target, distance=float(rng.uniform(0.1, 1.0)))


def _around(rng: np.random.Generator, d: int) -> np.ndarray:
    T = np.eye(d + 1)
    T[:d, :d], T[:d, d] = rotation(rng, d), 0.3 * rng.standard_normal(d)
    return T


def rotation(rng: np.random.Generator, d: int) -> np.ndarray:
    if d == 3:
        return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
