"""Kernels as plain Python (``NUMBA_DISABLE_JIT=1``) give the same results as compiled kernels."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dcreg
from dcreg import SolveOptions
from dcreg.names import BOUND_NAMES, MODEL_DIM, mode_names

ROOT = Path(__file__).parents[2]
N_POINTS = 6
# Pairs of points from which on mode full looks at the vertices of its boxes.
MANY = 33


def clouds(dim, n_points=N_POINTS, noise=0.02):
    """A cloud, and its copy with noise and one outlier."""
    generator = np.random.default_rng(dim)
    source = generator.standard_normal((n_points, dim))
    target = source + noise * generator.standard_normal(source.shape)
    target[-1] = generator.standard_normal(dim)
    return source, target[::-1].copy()


def problems():
    """Name and arguments of one small problem for every model, mode and bound."""
    for model, dim in MODEL_DIM.items():
        for mode in mode_names(model):
            for bound in (None,) if mode == "full" else BOUND_NAMES:
                yield f"{model} {mode} {bound}", clouds(dim), dict(model=model), (mode, bound)
        everything = np.ones((N_POINTS, N_POINTS), bool)
        everything[0, 0] = False
        yield f"{model} candidates", clouds(dim), dict(model=model, candidates=everything), (None,)
    yield "rigid3d many", clouds(3, MANY, 0.2), dict(model="rigid3d"), ("full",)


def summary(result, pose):
    return {
        "status": result.status.value,
        "bounds": [result.lower_bound, result.upper_bound],
        "pose": np.asarray(pose).tolist(),
        "n_nodes": result.n_nodes,
        "n_assignments": result.n_assignments,
    }


def solve_all():
    """Summaries of all problems by name."""
    found = {}
    for name, (source, target), problem, options in problems():
        n_inliers = len(source) - 1
        result = dcreg.register(
            source, target, n_inliers=n_inliers, **problem, options=SolveOptions(*options),
            node_limit=20, time_limit=None,
        )  # fmt: skip
        found[name] = summary(result, result.T_target_source)
    source, target = clouds(3)
    matches = np.argwhere(np.linalg.norm(source[:, None] - target[None], axis=2) < 1.5)
    for score in ("correspondences", "surfaces"):
        result = dcreg.register_matches(
            source, target, matches, inlier_distance=0.1, score=score, node_limit=20,
            time_limit=None,
        )  # fmt: skip
        found[f"matches {score}"] = summary(result, result.T_target_source)
    return found


@pytest.fixture(scope="module")
def both():
    """Summaries by compiled kernels, and by kernels as plain Python."""
    done = subprocess.run(
        [sys.executable, "-c", f"import json; from {__name__} import *; print(json.dumps(solve_all()))"],
        cwd=ROOT, env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return solve_all(), json.loads(done.stdout)
