"""The authors' Go-ICP through the user's `py_goicp` package, run in a child process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from baselines._shared.poses import homogeneous, rigid_pose
from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.status import Status

CHILD = Path(__file__).with_name("child.py")


class Adapter(Baseline):
    """Go-ICP as published: 300^3 distance transform, normalised clouds, translations in a cube."""

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        origin_source, origin_target = instance.source.mean(axis=0), instance.target.mean(axis=0)
        source, target = instance.source - origin_source, instance.target - origin_target
        unit = max(np.abs(source).max(), np.abs(target).max()) or 1.0
        problem = {
            "source": (source / unit).tolist(),
            "target": (target / unit).tolist(),
            "trim_fraction": trim_fraction(instance.n_inliers, len(source)),
            **self.options,
        }
        try:
            answer = _in_child(problem, limits.time_s)
        except subprocess.TimeoutExpired:
            pose = homogeneous(1.0, np.eye(3), origin_target - origin_source)
            message = "stopped at the time limit without a result of the package; "
            return Solution(Status.TIME_LIMIT, pose, message + "the pose aligns the centroids")
        if isinstance(answer, str):
            return Solution(Status.FAILED, None, answer)
        rotation, translation = np.array(answer["rotation"]), np.array(answer["translation"])
        # the single-precision rotation is made proper before it is applied to the origin
        found = rigid_pose(homogeneous(1.0, rotation, unit * translation + origin_target))
        if found is None:
            return Solution(Status.FAILED, None, "py_goicp returned a pose that is not finite")
        found[:3, 3] -= found[:3, :3] @ origin_source
        return Solution(Status.CONVERGED, found)


def trim_fraction(n_kept: int, n: int) -> float:
    """Return the fraction for which the library keeps floor(n (1 - fraction)) = `n_kept` points."""
    return 0.0 if n_kept == n else 1.0 - (n_kept + 0.5) / n


def _in_child(problem: dict[str, Any], time_s: float) -> dict[str, Any] | str:
    """Return the answer of the child, or the last line of its error output."""
    done = subprocess.run(
        [sys.executable, str(CHILD)],
        input=json.dumps(problem),
        capture_output=True,
        text=True,
        timeout=time_s,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return f"py_goicp ended with code {done.returncode}: {lines[-1] if lines else 'no message'}"
    return json.loads(done.stdout)
