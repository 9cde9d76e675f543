"""How soon matches are refuted: ``python -m workflows.studies.refute OUT``.

Can two clouds match at all? The study asks `dcreg.register` for 30 pairs with an RMS residual of at most
0.1 m (``max_rms``). The points are 100 keypoints of each of two 3DMatch fragments: farthest points of the
cloud on a grid of 5 cm. The feasible pairs are the five nearest FPFH descriptors of every source
keypoint (``--nearest``). There are two kinds of problems:

``different``
    Every tenth fragment of different scenes: the answer should be ``refuted``.
``planted``
    Fragments of different scenes. 30 target keypoints, chosen at random, are replaced by source keypoints
    moved by a random pose, with noise of an RMS between half of 0.1 m and all of it. These pairs are
    feasible too, so ``refuted`` is false.

The study writes ``refute.csv``, a row per problem, and ``refute_summary.csv``, a row per kind. Existing
rows are kept, so an interrupted study can be continued. Times exclude compilation. ``cpu_s`` is the CPU
time of the process, which counts in the summary: it does not depend on what else the machine does.
"""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
import typer
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import dcreg
from baselines._shared import open3d_clouds
from data.registry import dataset
from data.sampling import farthest_points
from data.threedmatch.loader import Loader, fragment, read_csv
from dcreg.files import whole_file
from dcreg.problem import apply_pose, largest_matching
from dcreg.status import Status

N_POINTS, N_INLIERS, MAX_RMS = 100, 30, 0.1  # the latter in metres
VOXEL = 0.05  # metres
STEP = 10  # between the fragments of a scene that are paired with those of other scenes
MOMENTS_S = 1.0, 10.0


class Question(NamedTuple):
    """Two sets of keypoints with their feasible pairs, and a pose that is known to meet the question."""

    source: np.ndarray
    target: np.ndarray
    candidates: np.ndarray
    T_known: np.ndarray | None = None

    def is_met_by(self, T: np.ndarray) -> bool:
        """Tell whether a pose has enough feasible pairs with a small RMS residual."""
        try:
            value, _ = dcreg.objective(self.source, self.target, T, N_INLIERS, self.candidates)
        except dcreg.InputError:
            return False
        return bool(value <= N_INLIERS * MAX_RMS**2)


class Keypoints(NamedTuple):
    """Keypoints of a fragment, with their descriptors."""

    points: np.ndarray
    features: np.ndarray


@cache
def keypoints(scene: str, number: int) -> Keypoints:
    """Return the keypoints of a fragment."""
    loader = dataset("threedmatch")
    assert isinstance(loader, Loader)
    path = loader.fetch_fragment(scene, number)
    cloud, features = open3d_clouds.downsampled(fragment(path, number), VOXEL)
    points = np.asarray(cloud.points)
    chosen = farthest_points(points, N_POINTS)
    return Keypoints(points[chosen], np.asarray(features.data).T[chosen])


def feasible_pairs(source: Keypoints, target: Keypoints, nearest: int) -> np.ndarray:
    """Return the mask of the pairs of each source keypoint with its `nearest` target descriptors."""
    _, columns = cKDTree(target.features).query(source.features, k=range(1, nearest + 1))
    mask = np.zeros((len(source.points), len(target.points)), dtype=bool)
    np.put_along_axis(mask, columns, True, axis=1)
    return mask


def different(number: int, nearest: int) -> Question:
    """Return the question of two fragments of different scenes."""
    rows = fragments_by_scene()
    rng = np.random.default_rng([28, number])
    scenes = rng.permutation(sorted(rows))[:2]
    source, target = (keypoints(scene, int(rng.choice(rows[scene]))) for scene in scenes)
    return Question(source.points, target.points, feasible_pairs(source, target, nearest))


def planted(number: int, nearest: int) -> Question:
    """Return a question of two fragments of different scenes that a planted pose meets."""
    source, target, candidates, _ = different(number, nearest)
    rng = np.random.default_rng([29, number])
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    T[:3, 3] = target.mean(axis=0) - T[:3, :3] @ source.mean(axis=0)
    rows, columns = (rng.permutation(N_POINTS)[:N_INLIERS] for _ in range(2))
    noise = rng.standard_normal((N_INLIERS, 3))
    noise *= rng.uniform(0.5, 1.0) * MAX_RMS / np.sqrt((noise**2).sum(axis=1).mean())
    target, candidates = target.copy(), candidates.copy()
    target[columns] = apply_pose(T, source[rows]) + noise
    candidates[rows, columns] = True
    return Question(source, target, candidates, T)


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
    n_different: Annotated[int, typer.Option("--different", help="problems of this kind")] = 40,
    n_planted: Annotated[int, typer.Option("--planted", help="problems of this kind")] = 0,
    nearest: Annotated[int, typer.Option(help="feasible pairs of a source keypoint")] = 5,
    limit: Annotated[float, typer.Option(help="seconds per problem")] = 10.0,
) -> None:
    """Ask the questions; print and store the tables."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    path = out / "refute.csv"
    rows: list[dict[Any, Any]] = pd.read_csv(path).to_dict("records") if path.exists() else []
    settings = {"nearest": nearest, "limit_s": limit}
    if any({name: row.get(name) for name in settings} != settings for row in rows):
        raise typer.BadParameter(f"{path} was made with other settings; give another folder")
    done = {(row["kind"], row["number"]) for row in rows}
    counts = {"different": n_different, "planted": n_planted}
    for kind, number in ((kind, at) for kind, count in counts.items() for at in range(count)):
        if (kind, number) not in done:
            rows.append(
                {"kind": kind, "number": number, **settings, **answer(kind, number, nearest, limit)}
            )
            with whole_file(path) as part:
                pd.DataFrame(rows).to_csv(part, index=False)
    table = summary(pd.DataFrame(rows))
    table.to_csv(out / "refute_summary.csv", index=False)
    print(table.to_string(index=False))


def answer(kind: str, number: int, nearest: int, limit: float) -> dict[str, object]:
    """Return the answer to a question."""
    question = {"different": different, "planted": planted}[kind](number, nearest)
    assert question.T_known is None or question.is_met_by(question.T_known)
    row: dict[str, object] = {"feasible": int(question.candidates.sum())}
    began = time.process_time()
    if (largest_matching(question.candidates) >= 0).sum() < N_INLIERS:  # refuted without a search
        return row | {
            "status": "refused",
            "time_s": 0.0,
            "cpu_s": 0.0,
            "is_false": kind == "planted",
        }
    found = dcreg.register(
        question.source, question.target, n_inliers=N_INLIERS, model="rigid3d",
        candidates=question.candidates, max_rms=MAX_RMS, time_limit=limit,
    )  # fmt: skip
    is_met = question.is_met_by(found.T_target_source)
    is_refuted = found.status is Status.REFUTED
    return row | {
        "status": "met" if is_met else found.status.value,
        "is_false": is_refuted and (is_met or kind == "planted"),
        "time_s": found.time_solve_s,
        "cpu_s": time.process_time() - began,
        "n_nodes": found.n_nodes,
        "stage": found.stages[0].name,
        "rms_proven": float(np.sqrt(found.lower_bound / N_INLIERS)),
        "rms_found": found.rmse_matched,
    }


def summary(answers: pd.DataFrame) -> pd.DataFrame:
    """Return a row per kind: the questions asked, and the shares of answers."""
    rows = []
    for kind, group in answers.groupby("kind", sort=False):
        is_refuted = group["status"].isin([Status.REFUTED.value, "refused"])
        is_met = group["status"] == "met"
        row: dict[str, object] = {"kind": kind, "questions": len(group), "met": int(is_met.sum())}
        for moment in MOMENTS_S:
            row[f"refuted {moment:g} s"] = int((is_refuted & (group["cpu_s"] <= moment)).sum())
        row["open"] = int((~is_refuted & ~is_met).sum())
        row["false"] = int(group["is_false"].sum())
        row["median_s"] = group["cpu_s"].median()
        rows.append(row)
    return pd.DataFrame(rows)


@cache
def fragments_by_scene() -> dict[str, list[str]]:
    """Return the numbers of every tenth fragment of each scene."""
    fragments: dict[str, list[str]] = {}
    for row in read_csv("fragments.csv"):
        fragments.setdefault(row["scene"], []).append(row["fragment"])
    return {scene: numbers[::STEP] for scene, numbers in fragments.items()}


if __name__ == "__main__":
    typer.run(main)
