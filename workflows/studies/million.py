"""Time and memory of a million runs: ``python -m workflows.studies.million OUT``.

The study writes synthetic results (`workflows.studies.synthetic`): files of solve jobs, plan and metrics.
Then the stage ``aggregate`` joins them, and ``python -m reports tables`` makes every table of the report.
Both are separate processes, so that their peak memory is known. ``million.csv`` holds what they took.

``costs.csv`` estimates what a million runs of each method take, from the runs of the latest archive.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from workflows import CHECKOUT, archives
from workflows.outcomes import attempted
from workflows.studies import synthetic

MOST_S, MOST_GB = 60.0, 4.0  # for a million runs on two cores


def main(
    out: Annotated[Path, typer.Argument(help="folder for results and tables")],
    rows: Annotated[int, typer.Option(help="number of runs, rounded up to 10,000")] = 1_000_000,
    report: Annotated[bool, typer.Option("--report", help="build the page as well")] = False,
) -> None:
    """Make all tables of synthetic runs; print seconds, peak memory, and sizes.

    The exit code is 1 if that takes more than `MOST_S` or `MOST_GB` with at most a million runs.
    """
    rows = synthetic.RUNS_PER_TRIAL * -(-rows // synthetic.RUNS_PER_TRIAL)
    table = study(out, rows, report=report)
    print(table.to_string(index=False))
    table.to_csv(out / "million.csv", index=False)
    costs().to_csv(out / "costs.csv", index=False)
    tables = table[table["step"] != "report"]
    seconds, peak_gb = tables["wall_s"].sum(), tables["peak_gb"].max()
    print(
        f"{rows:,} runs: {seconds:.1f} s, {peak_gb:.2f} GB "
        f"(for a million on two cores: at most {MOST_S:g} s, {MOST_GB:g} GB)"
    )
    raise typer.Exit(int(rows <= 1_000_000 and (seconds > MOST_S or peak_gb > MOST_GB)))


def study(out: Path, rows: int, *, report: bool = False) -> pd.DataFrame:
    """Return a row per step: wall and CPU seconds, peak memory, files and bytes that it wrote."""
    out = out.resolve()
    for name in ("results", "tables", "report"):
        shutil.rmtree(out / name, ignore_errors=True)
    began = time.monotonic()
    config, folder = synthetic.write(out, -(-rows // synthetic.RUNS_PER_TRIAL))
    files, size = _size(folder / "runs")
    print(
        f"synthetic results: {files:,} files of solve jobs, {size / rows:.0f} bytes a run; "
        f"{time.monotonic() - began:.0f} s",
        flush=True,
    )
    tables = folder / "tables"
    steps = {
        "aggregate": (["workflows", "aggregate", str(config), str(folder)], tables),
        "tables": (["reports", "tables", str(tables), str(out / "tables")], out / "tables"),
    }
    if report:
        page = out / "report" / "index.html"
        steps["report"] = (["reports", "experiment", str(tables), str(page)], page.parent)
    return pd.DataFrame(
        [{"step": step, **_measured(call, made)} for step, (call, made) in steps.items()]
    )


def costs(runs_each: int = 1_000_000) -> pd.DataFrame:
    """Return what so many runs take, by those of the latest archive.

    A row per experiment, model and method. Methods may have run on different machines. Hours are those
    of one core, by the mean; ``at_a_limit`` is the share of runs that would take longer without their
    limit.

    Raises
    ------
    ArchiveError
    """
    archive = archives.folders()[-1]
    archives.check(archive)
    columns = ["experiment", "model", "method", "outcome", "time_solve_s", "time_overhead_s"]
    runs = attempted(pd.read_parquet(archive / archives.RUNS, columns=columns))
    seconds = runs["time_solve_s"] + runs["time_overhead_s"].fillna(0.0)
    runs = runs.assign(seconds=seconds, at_a_limit=runs["outcome"].eq("limited"))
    by_method = runs.groupby(["experiment", "model", "method"])
    table = by_method.agg(
        runs=("seconds", "size"), at_a_limit=("at_a_limit", "mean"), median_s=("seconds", "median"),
        mean_s=("seconds", "mean"),
    )  # fmt: skip
    table["hours"] = (table["mean_s"] * runs_each / 3600).round(1)
    return table.reset_index().sort_values(["experiment", "model", "hours"], ignore_index=True)


def _measured(call: list[str], made: Path) -> dict[str, float]:
    """Run a command of this project; return what it took and how much it wrote."""
    began = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", *call], cwd=CHECKOUT)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - began
    if process.returncode:
        raise RuntimeError(f"`{' '.join(call)}` failed")
    files, size = _size(made)
    return {
        "wall_s": round(wall_s, 1),
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "peak_gb": round(used.ru_maxrss / 2**20, 2),
        "files": files,
        "mb": round(size / 1e6, 1),
    }


def _size(folder: Path) -> tuple[int, int]:
    """Return number and bytes of the files of a folder."""
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return len(sizes), sum(sizes)


if __name__ == "__main__":
    typer.run(main)
