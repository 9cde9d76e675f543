"""``dcreg register`` with default options on real clouds: ``python -m workflows.studies.walk OUT``.

Every pair of clouds is written to files at several sizes and registered with only the model, the time
limit and `n_inliers` as a share. For scans this share is 0.8 times the overlap at the true pose: a good
guess, which users may not have. Scans are moved by a random pose, so that the identity is not near the
true pose. A pose is right if its rotation error is below 15 degrees and its translation error below a
tenth of the target's longest side. The study writes ``walk.csv``: pose errors, status, times, warnings.
It needs the data that `data/` fetches. ``--checkout`` runs the `dcreg` of another checkout, such as an
older version; `curves` compares two tables.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data.contract import PrototypeDataset, RecordedDataset
from data.registry import dataset
from data.sampling import farthest_points
from data.threedmatch.loader import fragment
from dcreg.io import read_points
from dcreg.names import DEFAULT_TIME_LIMIT_S
from dcreg.problem import apply_pose, rotation_angle_deg

SIZES = [100, 300, 1000, 5000, 0]
KILLED_AFTER = 5.0  # in time limits; a run that takes longer is killed and has the status ``hang``
# Overlaps of the pairs of fragments, one pair per scene of 3DMatch.
OVERLAPS = (0.55, 0.75, 0.4, 0.55, 0.4, 0.75, 0.55, 0.75)
# Pairs of raw clouds that should be registered within seconds at full size (`--only-raw`).
RAW = (
    "7-scenes-redkitchen", "sun3d-home_at", "sun3d-hotel_uc", "sun3d-hotel_umd-maryland_hotel1",
    "sun3d-mit_lab", "bunny with missing ends", "bunny, half with clutter", "street",
)  # fmt: skip
SAME = 0.01  # relative change of the upper bound up to which a pose counts as the same
CLUTTER = 0.3  # clutter points of a target, per point of the object


@dataclass(frozen=True)
class CloudPair:
    """Two whole clouds, n_inliers as a share of the smaller one, and the true pose if it is known."""

    name: str
    source: np.ndarray
    target: np.ndarray
    share: float
    T_true: np.ndarray | None
    at_random: bool = False  # sampling; farthest points of a cluttered cloud are mostly clutter


def main(
    out: Annotated[Path, typer.Argument(help="folder for the table")],
    size: Annotated[list[int], typer.Option(help="points per cloud, 0: all")] = SIZES,
    limit: Annotated[float, typer.Option(help="seconds per run")] = DEFAULT_TIME_LIMIT_S,
    only: Annotated[str, typer.Option(help="part of a pair's name")] = "",
    only_raw: Annotated[bool, typer.Option(help="the pairs of `RAW`, at full size")] = False,
    every: Annotated[int, typer.Option(help="take every n-th run")] = 1,
    checkout: Annotated[Path, typer.Option(help="repository whose dcreg runs")] = Path(),
) -> None:
    """Register every pair at every size; print and store the table."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    warm_up = [sys.executable, "-c", "import dcreg; dcreg.warm_up()"]
    subprocess.run(warm_up, cwd=checkout, check=True)  # compiled kernels are read from the cache
    pairs = [pair for pair in (raw_pairs() if only_raw else cloud_pairs()) if only in pair.name]
    runs = [(pair, n_points) for pair in pairs for n_points in ([0] if only_raw else size)]
    for pair, n_points in runs[::every]:
        rows.append(walked(pair, n_points, limit, out.resolve(), checkout))
        print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(out / "walk.csv", index=False)
    print(table.drop(columns="warnings").to_string(index=False))
    print(_summary(table))
    print(f"tables: {out}")


def cloud_pairs() -> Iterator[CloudPair]:
    """Yield pairs of clouds of one object, and scans with published poses."""
    rng = np.random.default_rng(7)
    bunny = _prototypes("bunny")
    model, data = bunny.points("goicp_model", 35_947), bunny.points("goicp_data", 30_379)
    yield CloudPair("go-icp bunny", data, model, 0.8, None)
    for name in ("horse", "dino"):
        shapes = _prototypes(name)
        cloud = shapes.points(shapes.shapes()[0], 2_000)
        yield _turned(name, cloud, rng)
    yield _turned("bunny", model, rng)
    yield _cluttered("bunny", model, 16_000, rng)
    scenes = dataset("threedmatch").shapes()
    for scene, level in zip(scenes, OVERLAPS, strict=True):
        yield _scans("threedmatch", scene, "overlap", level)
    yield _scans("small_gicp", "street", "pair", 0.0)


def raw_pairs() -> Iterator[CloudPair]:
    """Yield the pairs of `RAW`."""
    return (pair for pair in cloud_pairs() if pair.name.startswith(RAW))


def _prototypes(name: str) -> PrototypeDataset:
    found = dataset(name)
    assert isinstance(found, PrototypeDataset)
    return found


def _turned(name: str, cloud: np.ndarray, rng: np.random.Generator) -> CloudPair:
    """Return two overlapping parts of an object; the second one is moved and has noise."""
    along = np.argsort(cloud @ rng.standard_normal(3))
    cut = len(cloud) // 10
    first, second = cloud[along[:-cut]], cloud[along[cut:]]
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=3).as_matrix()
    T[:3, 3] = rng.uniform(-1.0, 1.0, 3)
    extent = float(np.ptp(cloud, axis=0).max())
    moved = apply_pose(T, second) + 0.005 * extent * rng.standard_normal(second.shape)
    return CloudPair(f"{name} with missing ends", first, moved, 0.8, T)


def _cluttered(name: str, cloud: np.ndarray, n_points: int, rng: np.random.Generator) -> CloudPair:
    """Return two samples of one half of an object; the second is moved and has noise and clutter."""
    along = cloud @ rng.standard_normal(3)
    half = cloud[along > np.median(along)]
    first, second = (half[rng.permutation(len(half))[:n_points]] for _ in range(2))
    low, high = half.min(axis=0), half.max(axis=0)
    extent = float((high - low).max())
    second = second + 0.005 * extent * rng.standard_normal(second.shape)
    clutter = rng.uniform(low, high, (round(CLUTTER * n_points), 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=5).as_matrix()
    T[:3, 3] = rng.uniform(-1.0, 1.0, 3)
    target = apply_pose(T, np.concatenate([second, clutter]))
    return CloudPair(f"{name}, half with clutter", first, target, 0.9, T, at_random=True)


def _summary(table: pd.DataFrame) -> str:
    """Return the share of right poses, times, and how many wrong poses have no warning."""
    known = table[table["right"].notna()]  # runs without an answer count as wrong
    wrong = known[~known["right"].astype(bool)]
    silent = wrong[wrong["n_warnings"] == 0]
    times = table["wall_s"]
    return (
        f"{len(known) - len(wrong)} of {len(known)} known poses right; wall time: median "
        f"{times.median():.1f} s, 90 % within {times.quantile(0.9):.1f} s; wrong without a warning: "
        f"{len(silent)}; wrong with status converged: {(wrong['status'] == 'converged').sum()}"
    )


def _scans(name: str, shape: str, test: str, level: float) -> CloudPair:
    scans = dataset(name)
    assert isinstance(scans, RecordedDataset)
    raw = scans.load(shape, test, level, 0, 100)
    files = scans.files(shape, test, level, 0)
    source, target = (
        _cloud(path, raw.info.get(side)) for path, side in zip(files, ("src", "ref"), strict=False)
    )
    reach = 0.02 * float(np.ptp(target, axis=0).max())
    near = cKDTree(target).query(apply_pose(raw.T_true, source))[0] < reach
    share = round(max(0.1, 0.8 * float(near.mean())), 2)
    # recorded scans are nearly aligned, and no initial pose should profit from that
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=11).as_matrix()
    motion[:3, 3] = -motion[:3, :3] @ source.mean(axis=0)
    return CloudPair(
        f"{shape} {level:g}", apply_pose(motion, source), target, share,
        raw.T_true @ np.linalg.inv(motion),
    )  # fmt: skip


def _cloud(path: Path, number: float | str | None) -> np.ndarray:
    """Return a whole cloud of a dataset: a numbered fragment, or a file of points."""
    return read_points(path) if number is None else fragment(path, int(number))


def walked(
    pair: CloudPair, n_points: int, limit: float, out: Path, checkout: Path = Path()
) -> dict[str, Any]:
    """Register one pair by the command line; `out` is an absolute path."""
    clouds = sampled_clouds(pair, n_points)
    paths = [out / "source.npy", out / "target.npy"]
    for path, cloud in zip(paths, clouds, strict=True):
        np.save(path, cloud)
    answer, trace = out / "answer.json", out / "trace.jsonl"
    answer.unlink(missing_ok=True)
    command = [sys.executable, "-m", "dcreg", "register", *map(str, paths), "--model", "rigid3d"]
    command += ["--n-inliers", f"{pair.share}", "--time-limit", f"{limit}"]
    command += ["--json", str(answer), "--trace", str(trace)]
    began, status = time.perf_counter(), "no answer"
    try:
        code = subprocess.run(
            command, capture_output=True, timeout=KILLED_AFTER * limit, check=False, cwd=checkout
        ).returncode
    except subprocess.TimeoutExpired:
        code, status = -9, "hang"
    row: dict[str, Any] = {
        "pair": pair.name,
        "points": f"{len(clouds[0])} {len(clouds[1])}",
        "n_inliers": pair.share,
        "exit": code,
        "status": status,
        "wall_s": round(time.perf_counter() - began, 2),
        "right": None if pair.T_true is None else False,
        "warnings": "",
        "n_warnings": 0,
    }
    if answer.is_file():
        found = json.loads(answer.read_text())
        row["status"], row["mode"] = found["status"], found["mode"]
        row |= pose_errors(pair, np.array(found["T_target_source"]))
        row["before_solve_s"] = round(row["wall_s"] - found["time_solve_s"], 2)
        # the pose of a sample is judged after its refinement on all points, which ends the solve
        is_sampled = found.get("downsampled") is not None
        last_s = found["time_solve_s"] if is_sampled else _last_change_s(trace)
        row["pose_s"] = round(row["before_solve_s"] + last_s, 2)
        row["warnings"] = " | ".join(found.get("warnings", []))
        row["n_warnings"] = len(found.get("warnings", []))
    return row


def _last_change_s(trace: Path) -> float:
    """Return the time in seconds since which the upper bound stayed within `SAME` of its last value."""
    events = pd.read_json(trace, lines=True)
    last = events["upper_bound"].iloc[-1]
    differs = (events["upper_bound"] - last).abs() > SAME * last
    n_before = int(np.flatnonzero(differs)[-1]) + 1 if differs.any() else 0
    return float(events["time_s"].iloc[n_before])


def pose_errors(pair: CloudPair, T: np.ndarray) -> dict[str, object]:
    """Return residual and, if the true pose is known, errors and whether the pose is right.

    The residual is the RMS distance from the target of the best share of the source points. Residual and
    shift are in longest sides of the target.
    """
    moved = apply_pose(T, pair.source[:: max(1, len(pair.source) // 2000)])
    near = np.sort(cKDTree(pair.target).query(moved)[0])[: int(pair.share * len(moved))]
    extent = float(np.ptp(pair.target, axis=0).max())
    errors: dict[str, object] = {"residual": round(float(np.sqrt((near**2).mean())) / extent, 4)}
    if pair.T_true is not None:
        turn = rotation_angle_deg(T[:3, :3] @ pair.T_true[:3, :3].T)
        centre = pair.source.mean(axis=0)[None]
        shift = np.linalg.norm(apply_pose(T, centre) - apply_pose(pair.T_true, centre)) / extent
        errors |= {"turn_deg": round(float(turn), 1), "shift": round(float(shift), 3)}
        errors["right"] = bool(turn < 15.0 and shift < 0.1)
    return errors


def sampled_clouds(pair: CloudPair, n_points: int) -> list[np.ndarray]:
    """Return both clouds with about `n_points` points; 0 means all."""
    if not pair.at_random:
        return [_sampled(cloud, n_points) for cloud in (pair.source, pair.target)]
    least = min(len(pair.source), len(pair.target))
    return [
        _sampled(cloud, round(n_points * len(cloud) / least), at_random=True)
        for cloud in (pair.source, pair.target)
    ]


def _sampled(cloud: np.ndarray, n_points: int, at_random: bool = False) -> np.ndarray:
    if n_points == 0 or n_points >= len(cloud):
        return cloud
    rng = np.random.default_rng(0)
    some = cloud[rng.permutation(len(cloud))[: (1 if at_random else 20) * n_points]]
    return some[farthest_points(some, n_points)]


if __name__ == "__main__":
    typer.run(main)
