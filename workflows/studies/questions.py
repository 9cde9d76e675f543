"""``python -m workflows.studies.questions``: every question about one pair of 3DMatch fragments.

The clouds are 100 keypoints of two fragments that overlap. The feasible pairs of a source keypoint are
those with the nearest descriptors of the target. The official pose is known; only `certify` receives it.
The table is that of the page *Questions* of the manual.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import typer

import dcreg
from data.registry import dataset
from data.threedmatch.loader import Loader
from dcreg.problem import rotation_angle_deg
from dcreg.text import table
from workflows.studies.refute import feasible_pairs, keypoints

SCENE, OVERLAP = "7-scenes-redkitchen", 0.6
DISTANCE = 0.1  # metres


def main(
    nearest: Annotated[int, typer.Option(help="feasible pairs of a source keypoint")] = 5,
    limit: Annotated[float, typer.Option(help="seconds per question")] = 60.0,
) -> None:
    """Print a table of questions and answers."""
    loader = dataset("threedmatch")
    assert isinstance(loader, Loader)
    instance = loader.load(SCENE, "3DMatch", OVERLAP, 0, None)
    source, target = (keypoints(SCENE, int(instance.info[side])) for side in ("src", "ref"))
    clouds = source.points, target.points
    candidates = feasible_pairs(source, target, nearest)
    rows = list(answers(clouds, candidates, instance.T_true, limit))
    print(table(["question", "answer", "time"], rows, ["question", "answer"]))


def answers(
    clouds: tuple[np.ndarray, np.ndarray], candidates: np.ndarray, T_true: np.ndarray, limit: float
) -> Iterator[tuple[str, str, str]]:
    """Yield questions, answers, and seconds."""
    source, target = clouds
    given: dict[str, Any] = {"model": "rigid3d", "candidates": candidates, "time_limit": limit}
    count = dcreg.max_inliers(source, target, distance=DISTANCE, **given)
    yield f"how many pairs are within {DISTANCE:g} m?", count.answer, f"{count.time_s:.1f} s"
    problem = {**given, "n_inliers": count.at_least}
    found = dcreg.register(source, target, **problem)
    error = np.linalg.inv(T_true) @ found.T_target_source
    yield (
        f"which pose matches {count.at_least} pairs best?",
        f"{found.status}, {found.bound_ratio:.0%} proven; {rotation_angle_deg(error[:3, :3]):.1f} "
        f"degrees and {np.linalg.norm(error[:3, 3]):.2f} m from the official pose",
        f"{found.time_solve_s:.1f} s",
    )
    judged = dcreg.certify(source, target, T_true, **problem)
    yield (
        "is the official pose optimal?",
        f"{judged.verdict}: its objective is {judged.objective:.3g}, the best one known "
        f"{judged.result.objective:.3g}",
        f"{judged.result.time_solve_s:.1f} s",
    )
    others = dcreg.alternatives(source, target, **problem)
    yield "is the best pose the only one?", others.answer, f"{others.time_s:.1f} s"
    for most in (0.1, 0.01):
        met = dcreg.register(source, target, **problem, max_rms=most)
        answer = f"{met.status}{': ' * bool(met.reason)}{met.reason}"
        yield (
            f"do {found.n_inliers} pairs fit to {most:g} m (RMS)?",
            answer,
            f"{met.time_solve_s:.1f} s",
        )
    near = dcreg.PoseRange(max_angle=20.0, around=T_true)
    limited = dcreg.register(source, target, **problem, pose_range=near)
    yield (
        "which pose within 20 degrees of it?",
        f"{limited.status}, {limited.bound_ratio:.0%} proven",
        f"{limited.time_solve_s:.1f} s",
    )
    assert found.covariance is not None
    sigma = np.sqrt(np.diag(found.covariance))
    yield (
        "how sure is each direction?",
        f"rotation {np.degrees(sigma[:3]).round(1).tolist()} degrees, "
        f"translation {sigma[3:].round(3).tolist()} m; "
        f"{len(found.open_directions or [])} open directions",
        "",
    )


if __name__ == "__main__":
    typer.run(main)
