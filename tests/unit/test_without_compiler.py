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
from dcreg.families.registry import bounds_of
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.kernels.boxes import FEW_PAIRS
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.names import MODEL_DIM, mode_names
from dcreg.search import Boxes

ROOT = Path(__file__).parents[2]
N_POINTS = 5
COMMAND = "import json, test_without_compiler as test; print(json.dumps(test.solve_all()))"


def clouds(dim):
    """A cloud, and its copy with noise and one outlier."""
    generator = np.random.default_rng(dim)
    source = generator.standard_normal((N_POINTS, dim))
    target = source + 0.05 * generator.standard_normal(source.shape)
    target[-1] = generator.standard_normal(dim)
    return source, target[::-1].copy()


SPACES = {
    "similarity2d": lambda: Similarity2D(*clouds(2), N_POINTS - 1, (0.5, 1.5)),
    "rigid3d": lambda: Translation3D(*clouds(3), N_POINTS - 1),
}


def settings():
    """Model, mode, bound and whether some pairs are infeasible: all there are."""
    for model, space in SPACES.items():
        for mode in mode_names(model):
            for bound in bounds_of(type(space())) if mode == "paper" else [None]:
                yield model, mode, bound, False
            yield model, mode, None, True


def solve(model, mode, bound, restricted):
    """What a solve finds, as JSON can hold it."""
    source, target = clouds(MODEL_DIM[model])
    feasible = ~np.eye(N_POINTS, dtype=bool)
    result = dcreg.register(
        source, target, n_inliers=N_POINTS - 1, model=model, tol=1e-4, node_limit=16,
        candidates=feasible if restricted else None, time_limit=None,
        options=SolveOptions(mode=mode, bound=bound),
    )  # fmt: skip
    return summary(result, result.lower_bound, result.upper_bound)


def solve_matches():
    """The same of a registration over correspondences."""
    source, target = clouds(3)
    matches = np.argwhere(np.linalg.norm(source[:, None] - target[None], axis=2) < 2.0)
    result = dcreg.register_matches(
        source, target, matches, inlier_distance=0.1, node_limit=16, time_limit=None
    )
    return summary(result, result.score.reached)


def summary(result, *numbers):
    return {
        "status": result.status.value,
        "n_nodes": result.n_nodes,
        "pose": np.asarray(result.T_target_source).tolist(),
        "numbers": [*map(float, numbers)],
    }


def bound_boxes(bound):
    """Bounds and values of ever smaller boxes about the pose at which a descent ends."""
    centre, _, _ = bound.space.refine(bound.space.seeds()[0])
    widths, found = bound.roots[0].upper - bound.roots[0].lower, []
    for size in 0.3, 0.1, 0.03, 1e-3:
        boxes = Boxes((centre - size * widths)[None], (centre + size * widths)[None])
        outcome = bound.evaluate(boxes, 1.0)
        found += [*outcome.lower_bounds, *outcome.values]
    return {"numbers": found, "n_assignments": bound.n_assignments}


def many_pairs():
    """A rigid space with so many pairs that their boxes are bounded by duals."""
    source, target = clouds(3)
    others = np.random.default_rng(1).standard_normal((FEW_PAIRS // N_POINTS, 3))
    return Rigid3D(source, np.vstack([target, others]), N_POINTS - 1)


def solve_all():
    """What every solve finds, by its settings."""
    found = {str(setting): solve(*setting) for setting in settings()}
    for space in [make() for make in SPACES.values()]:
        for name, bound in bounds_of(type(space)).items():
            found[f"{name} in {type(space).__name__}"] = bound_boxes(bound(space))
    found["many pairs"] = bound_boxes(RigidBound(many_pairs()))
    return found | {"matches": solve_matches()}


@pytest.mark.slow
def test_plain_python_finds_the_same():
    done = subprocess.run(
        [sys.executable, "-c", COMMAND], cwd=Path(__file__).parent, capture_output=True, text=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    interpreted, compiled = json.loads(done.stdout), solve_all()
    assert interpreted.keys() == compiled.keys()
    for name, expected in compiled.items():
        found = interpreted[name]
        for key in "numbers", "pose":
            numbers = (np.array(each.pop(key, []), float) for each in (found, expected))
            np.testing.assert_allclose(*numbers, rtol=1e-7, atol=1e-9, err_msg=f"{name} {key}")
        assert found == expected, name
