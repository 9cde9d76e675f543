"""`dcreg` and methods with descriptors on the same raw pairs: ``python -m workflows.studies.peers OUT``.

The pairs are those of ``walk --only-raw``. The peers use their own front ends and parameters, once with
voxels of 1/50 and once of 1/100 of the target's longest side; the table has a row for each. They may use
two threads; `dcreg` uses its default number. Column `call_s` is the time of the call in seconds, in a
process that has loaded the library. Column `wall_s` of `dcreg` includes the start of its process. Only
`dcreg` uses `n_inliers`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from baselines.contract import Instance
from dcreg.names import DEFAULT_TIME_LIMIT_S
from workflows.config import LimitSettings, MethodSettings
from workflows.stages.sandbox import Sandbox
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
        rows[-1]["call_s"] = rows[-1]["wall_s"] - rows[-1].get("before_solve_s", 0.0)
        rows += [_solved(pair, size, name, voxel, out) for name in PEERS for voxel in VOXELS]
        print(pd.DataFrame(rows[-1 - len(PEERS) * len(VOXELS) :]).to_string(), flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(out / "peers.csv", index=False)
    print(summary(table).to_string())
    print(f"tables: {out}")


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return right poses, median rotation error, and times for each method and voxel size."""
    groups = table.fillna({"voxel": 0.0}).groupby(["method", "voxel"], sort=False)
    return groups.agg(
        right=("right", "sum"),
        pairs=("right", "size"),
        turn_deg=("turn_deg", "median"),
        median_s=("call_s", "median"),
        most_s=("call_s", "max"),
    )


def _solved(pair: CloudPair, size: int, name: str, voxel: float, out: Path) -> dict[str, object]:
    source, target = sampled_clouds(pair, size)
    instance = Instance(
        instance_id=pair.name, source=source, target=target, model="rigid3d",
        n_inliers=round(pair.share * min(len(source), len(target))), scale_range=(1.0, 1.0),
        noise_bound=voxel * float(np.ptp(target, axis=0).max()), seed=0,
    )  # fmt: skip
    row: dict[str, object] = {"method": name, "pair": pair.name, "voxel": voxel, "right": False}
    settings = MethodSettings(name=name, baseline=name, options={"front_end": "own"})
    limits = LimitSettings(time_s=DEFAULT_TIME_LIMIT_S, memory_mb=8192, threads=2)
    with Sandbox(settings, limits, out / "peers.log") as sandbox:  # some cannot share a process
        answer = sandbox.solve(instance)
    row |= {"status": str(answer["status"]), "call_s": answer.get("time_solve_s")}
    row["message"] = answer.get("message", "")
    T = answer.get("T_target_source")
    return row if T is None else row | pose_errors(pair, np.array(T))


if __name__ == "__main__":
    typer.run(main)
