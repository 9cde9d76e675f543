"""Count how often the comparison detects known changes: ``python -m tests.bench.planted OUT.csv``.

Each trial compares the checkout with an unchanged copy, and with copies that are made slower or looser on
purpose (*planted* changes). All run in turn, in new processes (`tests.bench.interleaved`), and each copy
is judged as by ``make compare``. The copies are in a temporary folder. The command appends to the table,
so a stopped experiment continues.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pandas as pd
import typer

from tests.bench.interleaved import FEW, REPETITIONS, ROOT, TIMED, measure
from workflows.timing import FEWEST, judge, judge_work

COUNT = 20
LOOSENING = "loosening"  # its work is counted, and its time is not measured
IN_KERNEL = [
    problem for problem in TIMED if problem[1] is FEW
]  # problems that use the slower kernel


class Change(NamedTuple):
    """A planted change: the text of a file and what replaces it."""

    file: str
    old: str
    new: str


CHANGES = {
    "unchanged": None,
    "slow-down": Change(  # the kernel does 30 % of its work, costs and assignments of vertices, twice
        "dcreg/families/dc/kernels.py",
        "            pair_costs(clouds, theta, cost)\n"
        "            curvature(clouds.target, clouds, delta, missed)\n"
        "            for i in range(n):\n"
        "                for j in range(m):\n"
        "                    cost[i, j] -= missed[i]\n"
        "            value, col_of = k_assignment(cost, clouds.k, clouds.stop)\n",
        "            for turn in range(2 if n_assignments % 10 < 3 else 1):\n"
        "                pair_costs(clouds, theta, cost)\n"
        "                curvature(clouds.target, clouds, delta, missed)\n"
        "                for i in range(n):\n"
        "                    for j in range(m):\n"
        "                        cost[i, j] -= missed[i]\n"
        "                value, col_of = k_assignment(cost, clouds.k, clouds.stop)\n",
    ),
    LOOSENING: Change(  # by about 2 % of the linearisation loss of a box
        "dcreg/families/protocol.py",
        "        found = self._evaluate(boxes[touched], cutoff)\n",
        "        found = self._evaluate(boxes[touched], cutoff)\n"
        "        widths = (boxes.upper - boxes.lower)[touched]\n"
        "        found.lower_bounds -= 0.005 * self.space.n_inliers * (widths**2).sum(axis=1)\n",
    ),
}


def plant(change: Change | None, copy: Path) -> Path:
    """Copy the library of the checkout to a folder, and make the change there."""
    shutil.copytree(ROOT / "dcreg", copy / "dcreg")  # with Numba's cache
    if change is not None:
        path = copy / change.file
        text = path.read_text(encoding="utf-8")
        if text.count(change.old) != 1:
            raise SystemExit(f"{path}: the text to change is not there once; adapt `CHANGES`")
        path.write_text(text.replace(change.old, change.new), encoding="utf-8")
    return copy


def outcome(change: str, trial: int, table: pd.DataFrame) -> dict[str, Any]:
    """Return the row of one comparison: what it found, and the figures behind it."""
    times, work = list(judge(table)), list(judge_work(table))
    row = {
        "change": change,
        "trial": trial,
        "repetitions": table["repetition"].nunique(),
        "alarm": any(each.verdict in ("slower", "worse") for each in (*times, *work)),
        "alarm_time": any(each.verdict == "slower" for each in times),
        "alarm_work": any(each.verdict == "worse" for each in work),
    }
    for each in times:
        ratio = each.ratio
        row |= {
            f"{each.group}_ratio": ratio.estimate, f"{each.group}_low": ratio.low,
            f"{each.group}_high": ratio.high, f"{each.group}_noise": each.noise,
        }  # fmt: skip
    return row | {f"{each.counter}_ratio": each.head / each.base for each in work}


def main(
    out: Annotated[Path, typer.Argument(help="CSV file for the table.")],
    count: Annotated[int, typer.Option(help="Trials.")] = COUNT,
    first: Annotated[int, typer.Option(help="Number of the first trial.")] = 0,
    repetitions: Annotated[int, typer.Option(min=FEWEST)] = REPETITIONS,
) -> None:
    """Run the experiment, or the rest of it."""
    known = pd.read_csv(out) if out.is_file() else pd.DataFrame({"trial": []})
    rows = known.to_dict("records")
    with tempfile.TemporaryDirectory() as folder:
        copies = {name: plant(change, Path(folder, name)) for name, change in CHANGES.items()}
        for trial in range(first, first + count):
            if trial in set(known["trial"]):
                continue
            began = time.monotonic()
            counted = {LOOSENING: copies[LOOSENING]}
            timed = {name: copy for name, copy in copies.items() if name not in counted}
            tables = measure(ROOT, timed, repetitions, IN_KERNEL)
            tables |= measure(ROOT, counted, repetitions=0, timed=())
            rows += [outcome(name, trial, table) for name, table in tables.items()]
            out.parent.mkdir(parents=True, exist_ok=True)
            pd.DataFrame(rows).to_csv(out, index=False, float_format="%.5g")
            found = [row["change"] for row in rows[-len(CHANGES) :] if row["alarm"]]
            print(f"trial {trial}: found {found}; {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    typer.run(main)
