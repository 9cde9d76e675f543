"""How long `dcreg verify` takes beside the search: ``python -m workflows.studies.checks OUT``.

The problems are those of `workflows.studies.proof`: rigid poses in 3D, ``n_inliers`` the number of true
pairs. The study writes ``checks.csv``, a row per search that ended with status `optimal` within the
limit.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

import dcreg
from dcreg.status import Status
from workflows.studies.modes import SHAPES, TESTS
from workflows.studies.proof import Cell, cells


def main(
    out: Annotated[Path, typer.Argument(help="folder for the table and the files")],
    trials: Annotated[int, typer.Option(help="trials per shape, test and level")] = 1,
    limit: Annotated[float, typer.Option(help="seconds per search")] = 60.0,
    points: Annotated[int, typer.Option(help="points per shape")] = 100,
    tests: Annotated[str, typer.Option(help="tests, comma-separated")] = ",".join(TESTS),
    shapes: Annotated[str, typer.Option(help="datasets, comma-separated")] = ",".join(SHAPES),
) -> None:
    """Search and check; print and store the table."""
    dcreg.warm_up()
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for cell in cells(trials, tests.split(","), shapes.split(",")):
        if found := checked(cell, points, limit, out / "proof.npz"):
            rows.append(cell._asdict() | found)
            pd.DataFrame(rows).to_csv(out / "checks.csv", index=False)
            print(pd.DataFrame(rows[-1:]).to_string(index=False, header=len(rows) == 1), flush=True)


def checked(cell: Cell, points: int, limit: float, path: Path) -> dict[str, object] | None:
    """Return the times of a search and of the check of its file; None without a proof."""
    raw = cell.instance(points, plane=False)
    options = dcreg.SolveOptions(mode="full", prove=True, certificate=True)
    began = time.perf_counter()
    result = dcreg.register(
        raw.source, raw.target, n_inliers=len(raw.pairs), model="rigid3d", time_limit=limit,
        options=options,
    )  # fmt: skip
    search_s = time.perf_counter() - began - result.time_setup_s
    if result.status is not Status.OPTIMAL:
        return None
    result.write_certificate(path)
    report = dcreg.verify(path, raw.source, raw.target)
    return {
        "accepted": report.accepted,
        "search_s": search_s,
        "check_s": report.time_s,
        "ratio": report.time_s / search_s,
        "leaves": report.n_leaves,
        "boxes": report.n_boxes,
        "megabytes": path.stat().st_size / 1e6,
    }


if __name__ == "__main__":
    typer.run(main)
