"""Small fixed problems, and what of their results is kept: nothing that depends on the machine.

Bound, mode, start box and tolerance are always given, so that new defaults of the library change no
result here. A new problem is a new entry.

Not every problem is fit for this. Boxes that share a vertex can have equal bounds, in 3D as a rule;
rounding then decides which one is taken first, and with it how many are bounded until the best
incumbent is found. The problems below have the same counters when all coordinates are moved by
1e-13, which is tested.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import dcreg
from baselines import registry
from baselines.contract import Limits
from dcreg.problem import Problem
from dcreg.result import Result


@dataclass(frozen=True)
class Cloud:
    """Clouds that share `n_common` noisy points; the rest of each is uniform clutter."""

    seed: int
    n_common: int
    n_source: int
    n_target: int
    noise: float

    def points(self, dim: int) -> tuple[np.ndarray, np.ndarray]:
        """Source and target, rounded so that they are the same numbers on every machine."""
        generator = np.random.default_rng(self.seed)
        extent = np.array([1.0, 0.7, 0.5])[:dim]
        source = generator.random((self.n_source, dim)) * extent
        target = generator.random((self.n_target, dim)) * extent
        jitter = self.noise * (generator.random((self.n_common, dim)) - 0.5)
        target[: self.n_common] = source[: self.n_common] + jitter
        return source.round(6), (target @ _rotation(dim).T + [2.0, -1.0, 0.5][:dim]).round(6)


def _rotation(dim: int) -> np.ndarray:
    if dim == 2:  # with a scale of 0.8
        return 0.8 * np.array([[math.cos(2.0), -math.sin(2.0)], [math.sin(2.0), math.cos(2.0)]])
    return Rotation.from_rotvec([0.4, 1.9, -0.8]).as_matrix()


@dataclass(frozen=True)
class Case:
    model: str
    cloud: Cloud
    n_inliers: int
    bound: str
    gap_tol: float
    start_box: str = "stationary"
    node_limit: int | None = None
    polish: bool = True
    with_trace: bool = False
    scale_range: tuple[float, float] | None = None

    def solve(self, threads: int = 1, jitter: float = 0.0, seed: int = 0) -> Result:
        """The library's answer; `jitter` moves every coordinate by about that much."""
        generator = np.random.default_rng(seed)
        source, target = (
            points + jitter * generator.standard_normal(points.shape) for points in self.points()
        )
        if self.bound.startswith("termwise"):  # a bound of RPM-HTB
            method = registry.load("rpm_htb", search="ours", bound=self.bound, polish=self.polish)
            problem = Problem(source, target, self.n_inliers, self.model, self.scale_range)
            limits = Limits(60.0, self.node_limit, threads=threads)
            return method.result(problem, limits, 0.0, self.gap_tol)
        return dcreg.register(
            source,
            target,
            n_inliers=self.n_inliers,
            model=self.model,
            scale_range=self.scale_range,
            rel_gap=0.0,
            abs_gap=self.gap_tol,
            node_limit=self.node_limit,
            options=dcreg.SolveOptions(
                mode="paper",
                bound=self.bound,
                start_box=self.start_box,
                polish=self.polish,
                threads=threads,
            ),
        )

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        return self.cloud.points(2 if self.model == "similarity2d" else 3)

    def digest(self) -> str:
        """Hash of the coordinates: tells a changed problem from a changed solver."""
        rounded = [np.rint(points * 1e6).astype(np.int64) for points in self.points()]
        return hashlib.sha256(b"".join(points.tobytes() for points in rounded)).hexdigest()[:16]

    def outcome(self, threads: int = 1) -> dict[str, Any]:
        """What is compared, as plain values for JSON."""
        result = self.solve(threads)
        kept = {
            "points": self.digest(),
            "status": result.status.value,
            "n_nodes": result.n_nodes,
            "n_assignments": result.n_assignments,
            "lower_bound": result.lower_bound,
            "upper_bound": result.upper_bound,
            "objective": result.objective,
            "T_target_source": result.T_target_source.tolist(),
        }
        return {**kept, "trace": timeless(result)} if self.with_trace else kept


def timeless(result: Result) -> list[dict[str, Any]]:
    """The bound history without its clock."""
    return [
        {name: value for name, value in row.items() if name not in ("time_s", "expected_s")}
        for row in result.trace.rows()
    ]


COMPLETE_2D = Cloud(seed=1, n_common=12, n_source=12, n_target=12, noise=0.1)
CLUTTER_2D = Cloud(seed=1, n_common=8, n_source=10, n_target=11, noise=0.15)
COMPLETE_3D = Cloud(seed=3, n_common=14, n_source=14, n_target=14, noise=0.1)
CLUTTER_3D = Cloud(seed=12, n_common=10, n_source=12, n_target=13, noise=0.1)
ONE_SIDED_3D = Cloud(seed=4, n_common=10, n_source=10, n_target=14, noise=0.06)

CASES: dict[str, Case] = {
    "2d-complete-dc": Case("similarity2d", COMPLETE_2D, 12, "dc", 0.003),
    "2d-complete-safe": Case(
        "similarity2d", COMPLETE_2D, 12, "dc", 0.0005, start_box="radius", with_trace=True
    ),
    "2d-complete-interval": Case("similarity2d", COMPLETE_2D, 12, "interval", 0.003),
    "2d-complete-termwise": Case("similarity2d", COMPLETE_2D, 12, "termwise", 0.003),
    "2d-clutter-dc": Case("similarity2d", CLUTTER_2D, 8, "dc", 0.003, node_limit=400),
    "2d-clutter-both": Case("similarity2d", CLUTTER_2D, 8, "dc+interval", 0.006),
    "2d-complete-r1": Case(
        "similarity2d", COMPLETE_2D, 12, "termwise-r1", 0.003, node_limit=500, polish=False
    ),
    "2d-narrow-scale": Case(
        "similarity2d", COMPLETE_2D, 12, "dc+interval", 0.003, scale_range=(0.7, 0.9)
    ),
    "3d-complete-dc": Case("rigid3d", COMPLETE_3D, 14, "dc", 0.0025, start_box="radius"),
    "3d-clutter-both": Case("rigid3d", CLUTTER_3D, 10, "dc+interval", 0.0004),
    "3d-one-sided-interval": Case("rigid3d", ONE_SIDED_3D, 10, "interval", 0.0004),
}
