"""Small problems with small noise, of which the covariance of the pose is known by drawing it often."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.problem import Problem, apply_pose, scale_of
from tests.questions.problems import MODELS, rotation

DRAWS = 2000
NOISE = 1e-3  # relative to the second extent of the source, which determines the rotation


@dataclass(frozen=True)
class Noisy:
    """All source points have a noisy partner; the target has further points."""

    number: int
    problem: Problem
    sigma: float
    T: np.ndarray
    pairs: list[tuple[int, int]]

    def twists(self) -> np.ndarray:
        """Return the error of each fitted pose: rotation, translation, logarithm of the scale."""
        p, d = self.problem, self.problem.dim
        rng = np.random.default_rng([11, self.number])
        exact, inverse = apply_pose(self.T, p.source), np.linalg.inv(self.T)
        found = []
        for noise in self.sigma * rng.standard_normal((DRAWS, *exact.shape)):
            E = inverse @ p.fit(p.source, exact + noise)
            R = E[:d, :d] / (scale := scale_of(E))
            turn = [R[1, 0]] if d == 2 else [R[2, 1], R[0, 2], R[1, 0]]  # that of a small rotation
            found.append([*turn, *E[:d, d], *([np.log(scale)] if p.has_scale else [])])
        return np.array(found)

    def __str__(self) -> str:
        p = self.problem
        return (
            f"#{self.number} {p.model} noise {self.sigma:.2g} n={len(p.source)} m={len(p.target)}"
        )


def noisy(number: int) -> Noisy:
    """Return the problem of a number: 4 to 6 source points, and up to 3 further target points."""
    rng = np.random.default_rng([10, number])
    model = (*MODELS, "similarity3d")[number % 3]
    d = 2 if model == "similarity2d" else 3
    n, n_further = int(rng.integers(4, 7)), int(rng.integers(4))
    source = rng.standard_normal((n, d))
    sigma = NOISE * float(np.linalg.svd(source - source.mean(axis=0), compute_uv=False)[1])
    T = np.eye(d + 1)
    T[:d, :d], T[:d, d] = rotation(rng, d), rng.standard_normal(d)
    order = rng.permutation(n + n_further)
    target = np.vstack([
        apply_pose(T, source) + sigma * rng.standard_normal((n, d)),
        apply_pose(T, 3.0 * rng.standard_normal((n_further, d))),
    ])[order]  # fmt: skip
    is_fixed = model == "rigid3d" or rng.random() < 0.5
    problem = Problem(source, target, n, model, (1.0, 1.0) if is_fixed else (0.5, 1.5))
    pairs = [(row, int(column)) for row, column in enumerate(np.argsort(order)[:n])]
    return Noisy(number, problem, sigma, T, pairs)
