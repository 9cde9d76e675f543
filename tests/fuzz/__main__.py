"""``python -m tests.fuzz``: solve many small problems and count wrong certificates; 0 is expected.

Exit code 1 if any claim was wrong; the problem can be repeated by its number with ``--only``.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from rich.progress import track

import dcreg
from tests.fuzz.check import check
from tests.fuzz.problems import problem

OUT = Path("results/fuzz")


def main(
    count: Annotated[int, typer.Option(help="problems to solve")] = 10_000,
    first: Annotated[int, typer.Option(help="number of the first problem")] = 0,
    only: Annotated[int | None, typer.Option(help="just the problem of this number")] = None,
    family: Annotated[str | None, typer.Option(help="problems of this family alone")] = None,
    out: Annotated[Path, typer.Option(help="folder for the tables")] = OUT,
) -> None:
    dcreg.warm_up()
    numbers = range(first, first + count) if only is None else [only]
    began = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for number in track(numbers, "fuzz", disable=only is not None):
        rows.append(_row(number, family))
        if len(rows) % 500 == 0 or len(rows) == len(numbers):  # an interrupted run leaves its rows
            pd.DataFrame(rows).to_csv(out / "fuzz.csv", index=False)
    table = pd.DataFrame(rows)
    summary = table.groupby(["family", "bound"]).agg(
        problems=("number", "size"),
        optimal=("status", lambda s: int((s == "optimal").sum())),
        reference_closed=("closed", "sum"),
        candidates=(
            "n_pairs",
            lambda p: int((p < table.loc[p.index, "n"] * table.loc[p.index, "m"]).sum()),
        ),
        covered=("covers", lambda covers: int((covers > 0).sum())),
        wrong=("faults", lambda f: int((f != "").sum())),
    )
    print(summary.to_string())
    print(f"\nstatus: {dict(Counter(table['status']))}")
    wrong = table[table["faults"] != ""]
    for _, row in wrong.iterrows():
        print(f"WRONG {row['problem']}: {row['faults']}")
    print(
        f"{len(table):,} problems in {time.perf_counter() - began:.0f} s, "
        f"{len(wrong)} with a wrong claim; rows in {out / 'fuzz.csv'}"
    )
    raise typer.Exit(int(len(wrong) > 0))


def _row(number: int, family: str | None) -> dict[str, object]:
    drawn = problem(number, family)
    began = time.perf_counter()
    result = drawn.solve()
    solved = time.perf_counter()
    verdict = check(drawn, result)
    return {
        "number": number,
        "family": drawn.family,
        "kind": drawn.kind,
        "bound": result.bound,
        "n": len(drawn.source),
        "m": len(drawn.target),
        "n_inliers": drawn.n_inliers,
        "n_pairs": int(drawn.allowed.sum()),
        "status": result.status.value,
        "lower_bound": result.lower_bound,
        "upper_bound": result.upper_bound,
        "gap_tol": result.gap_tol,
        "optimum_low": verdict.lower,
        "optimum_high": verdict.upper,
        "closed": verdict.closed,
        "covers": sum(stage.outside is not None for stage in result.stages),
        "n_nodes": result.n_nodes,
        "solve_s": solved - began,
        "check_s": time.perf_counter() - solved,
        "faults": "; ".join(verdict.faults),
        "problem": str(drawn),
    }


if __name__ == "__main__":
    typer.run(main)
