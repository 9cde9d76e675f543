"""Compare two tables of `walk`: ``python -m workflows.studies.curves BEFORE.csv AFTER.csv OUT.svg``.

For each table, three curves show shares of runs against the seconds since the start of the process: runs
whose right final pose had been found, runs that had ended with a right pose, and runs that had ended with
a right pose and a proof. Only runs with known poses that are in both tables count. A table is named after
its folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

KEYS = ["pair", "points"]
MOMENTS_S = (2.0, 3.0, 5.0, 10.0, 30.0, 60.0)
CURVES = {"right pose found": "pose_s", "ended with a right pose": "wall_s", "proven": "proof_s"}


def main(
    before: Annotated[Path, typer.Argument(help="a table of walk")],
    after: Annotated[Path, typer.Argument(help="the table to compare with it")],
    out: Annotated[Path, typer.Argument(help="file for the figure, .svg or .png")],
) -> None:
    """Draw the curves; print their values at `MOMENTS_S`."""
    if before.parent.name == after.parent.name:
        raise typer.BadParameter(
            "the two tables are named after their folders: give different ones"
        )
    tables = {path.parent.name: pd.read_csv(path).drop_duplicates(KEYS) for path in (before, after)}
    times = pd.concat(
        {name: reached(_shared(table, list(tables.values()))) for name, table in tables.items()},
        names=["version", "row"],
    ).reset_index("version")
    print(f"{len(times) // 2} runs with known poses; shares in per cent at {MOMENTS_S} s")
    print(shares(times).to_string())
    _draw(times, out)
    print(f"figure: {out}")


def reached(table: pd.DataFrame) -> pd.DataFrame:
    """Return the seconds until each event of `CURVES`, per run with a known pose; inf: never."""
    known = table[table["right"].notna()]
    right = known["right"].astype(bool)
    known = known.assign(proof_s=known["wall_s"].where(known["status"] == "optimal"))
    return pd.DataFrame(
        {curve: known[column].where(right).fillna(np.inf) for curve, column in CURVES.items()}
    )


def shares(times: pd.DataFrame) -> pd.DataFrame:
    """Return the percentage of runs for which each event of `CURVES` had occurred by `MOMENTS_S`."""
    long = times.melt("version", var_name="curve", value_name="time_s")
    cells = long.groupby(["curve", "version"], sort=False)["time_s"]
    return pd.DataFrame(
        {f"{moment:g} s": 100 * cells.agg(_share_within, moment) for moment in MOMENTS_S}
    ).round()


def _share_within(times: pd.Series, moment: float) -> float:
    return float((times <= moment).mean())


def _shared(table: pd.DataFrame, tables: list[pd.DataFrame]) -> pd.DataFrame:
    for other in tables:
        table = table.merge(other[KEYS], on=KEYS)
    return table


def _draw(times: pd.DataFrame, out: Path) -> None:
    import seaborn

    long = times.melt("version", var_name="curve", value_name="time_s")
    grid = seaborn.displot(
        long, x="time_s", hue="version", col="curve", kind="ecdf", height=3.0, aspect=1.1
    )
    last = float(long["time_s"].replace(np.inf, np.nan).max())
    grid.set(xscale="log", xlim=(0.5, 1.05 * last), ylim=(0.0, 1.0))
    grid.set_titles("{col_name}").set_axis_labels("seconds since the start", "share of runs")
    grid.savefig(out)


if __name__ == "__main__":
    typer.run(main)
