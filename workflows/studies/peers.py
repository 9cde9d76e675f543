"""`dcreg` and methods with descriptors on the same raw pairs: ``python -m workflows.studies.peers OUT``.

The pairs are those of ``walk --only-raw``. The peers use their own front ends and recipes, with voxels of
1/50 and of 1/100 of the target's longest side; the table has both. Times of peers are those of the call,
in a process that has loaded the library. The time of `dcreg` includes the start of its process; its
column `call_s` does not. No method uses `n_inliers` but `dcreg`.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from baselines import registry
from baselines.contract import Instance, Limits
from dcreg.names import DEFAULT_TIME_LIMIT_S
from workflows.studies.walk import CloudPair, pose_errors, raw_pairs, sampled_clouds, walked

PEERS = ("kiss_matcher", "fpfh_ransac", "fpfh_fgr")
VOXELS = (1 / 50, 1 / 100)  # in longest sides of the target


def main(
    out: Annotated[Path, typer.Argument(help="folder for the table")],
    size: Annotated[int, typer.Option(help="points per cloud, 0: all")] = 0,
    limit: Annotated[float, typer.Option(help="seconds per run of dcreg")] = DEFAULT_TIME_LIMIT_S,
) -> None:
    """Register every pair by every method; print and store the table."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for pair in raw_pairs():
        rows.append({"method": "dcreg", **walked(pair, size, limit, out.resolve())})
        rows[-1]["call_s"] = rows[-1]["wall_s"] - rows[-1].get("before_solve_s", np.nan)
        rows += [_solved(pair, size, name, voxel) for name in PEERS for voxel in VOXELS]
        print(pd.DataFrame(rows[-1 - len(PEERS) * len(VOXELS) :]).to_string(), flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(out / "peers.csv", index=False)
    print(summary(table).to_string())
    print(f"tables: {out}")


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return right poses, and median and greatest time, for each method and voxel size."""
    groups = table.fillna({"voxel": 0.0}).groupby(["method", "voxel"], sort=False)
    return groups.agg(
        right=("right", "sum"),
        pairs=("right", "size"),
        turn_deg=("turn_deg", "median"),
        median_s=("call_s", "median"),
        most_s=("call_s", "max"),
    )


def _solved(pair: CloudPair, size: int, name: str, voxel: float) -> dict[str, object]:
    source, target = sampled_clouds(pair, size)
    instance = Instance(
        instance_id=pair.name, source=source, target=target, model="rigid3d",
        n_inliers=round(pair.share * min(len(source), len(target))), scale_range=(1.0, 1.0),
        noise_bound=voxel * float(np.ptp(target, axis=0).max()), seed=0,
    )  # fmt: skip
    row: dict[str, object] = {"method": name, "pair": pair.name, "voxel": voxel, "right": False}
    method = registry.load(name, front_end="own")
    if reason := method.available():
        return row | {"status": f"unavailable: {reason}", "right": None}
    method.warm_up(instance)
    began = time.perf_counter()
    found = method.solve(instance, Limits(time_s=DEFAULT_TIME_LIMIT_S))
    row |= {"call_s": time.perf_counter() - began, "status": found.status.value}
    T = found.T_target_source
    return row if T is None else row | pose_errors(pair, T)


if __name__ == "__main__":
    typer.run(main)
