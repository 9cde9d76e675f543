"""Compare the CPU time and the work of two checkouts, solve by solve: ``make timings OLD=folder``.

One process per checkout solves the same problems. All checkouts solve a problem directly one after the
other, in alternating order, so that the load of the machine affects them equally. A repetition keeps the
minimum of a few solves, because other processes only add CPU time (through caches and shared cores). On a
busy machine there are more repetitions, until the intervals of all ratios are narrow. The problems of
`COUNTED` are solved once, for their exact work. `workflows.timing` judges the table, and ``make compare
TIMES=…`` adds the verdicts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from tests.bench.cases import Subject
from tests.problems import OPTION_NAMES
from workflows.timing import FEWEST, is_precise, judge

ROOT = Path(__file__).parents[2]
SERVER = Path(__file__).with_name("solve_server.py")
REPETITIONS, MINIMUM_OF = 12, 4
MOST = 4  # times as many repetitions on a busy machine
SETTINGS = {"mode": "paper", "polish": False, "prove": True, "time_limit": 120.0}
FEW = {"bound": "dc", "node_limit": 60}  # most of their time is spent in compiled kernels
TIGHT = {"bound": "tight"}
# Limits on boxes make searches in default modes independent of elapsed time (`Budget.is_counted`).
DEFAULT: dict[str, Any] = {"mode": None, "polish": True}
Problem = tuple[Subject, dict[str, Any]]  # with the settings that differ from `SETTINGS`
TIMED: list[Problem] = [  # each kind of default search with few and with many point pairs
    (Subject("embedded", "fish", "mixed_outliers", 0.3, n_points=16, jitter=0.05), FEW),
    (Subject("embedded", "glyph", "mixed_outliers", 0.3, n_points=16, jitter=0.05), FEW),
    (Subject("embedded", "pony", "noise", 0.02, n_points=30, tau=0.01), TIGHT),
    (Subject("embedded", "fish", "mixed_outliers", 0.3, n_points=24, jitter=0.05), DEFAULT),
    (
        Subject("embedded", "fish", "mixed_outliers", 0.3, n_points=60, jitter=0.05),
        DEFAULT | {"node_limit": 500},
    ),
    (
        Subject("embedded", "pony", "mixed_outliers", 0.3, n_points=24, tau=0.01),
        DEFAULT | {"node_limit": 20_000},
    ),
    (
        Subject("embedded", "pony", "mixed_outliers", 0.3, n_points=40, jitter=0.03, tau=0.01),
        DEFAULT | {"node_limit": 3000},
    ),
]
COUNTED: list[Problem] = [
    (Subject("embedded", "fish", "mixed_outliers", 0.3, n_points=24, jitter=0.05), TIGHT),
    (Subject("embedded", "pony", "noise", 0.02, n_points=60, tau=0.01), TIGHT),
]


def problems(chosen: Sequence[Problem]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the arguments of `dcreg.register` for each problem, and its options, as plain values."""
    found = []
    for subject, settings in chosen:
        given = subject.problem() | SETTINGS | settings
        plain = {
            name: value.tolist() if hasattr(value, "tolist") else value
            for name, value in given.items()
        }
        options = {name: plain.pop(name) for name in OPTION_NAMES & plain.keys()}
        found.append((plain, options))
    return found


class Side:
    """A process that solves the problems with the library of one checkout."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process

    def solve(self, problem: int) -> dict[str, Any]:
        """Return the CPU time and the work of one solve."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{problem}\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


@contextmanager
def side(checkout: Path, file: Path) -> Iterator[Side]:
    """Start the process of a checkout; it ends with the context."""
    with subprocess.Popen(
        [sys.executable, SERVER, file], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(checkout.resolve())},
    ) as process:  # fmt: skip
        try:
            yield Side(process)
        finally:
            process.kill()


def measure(
    base: Path,
    heads: dict[str, Path],
    repetitions: int = REPETITIONS,
    timed: Sequence[Problem] = TIMED,
) -> dict[str, pd.DataFrame]:
    """Solve the problems with a checkout and with others in turn.

    Parameters
    ----------
    base : Path
    heads : dict of str to Path
        The checkouts to compare with the base, by name.
    repetitions : int
        At least; the maximum is `MOST` times as many.
    timed : sequence of Problem
        The problems that are repeated.

    Returns
    -------
    dict of str to DataFrame
        For each head a row per problem and repetition: ``group`` (the model, and whether its default
        mode is used), ``problem``, ``repetition``, and ``cpu_s``, ``status``, ``n_nodes`` and
        ``n_assignments`` of both checkouts, which end with ``_base`` and ``_head``. ``cpu_s`` is empty
        for problems that are only counted.
    """
    chosen = [*COUNTED, *timed]
    given = problems(chosen)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in heads}
    with ExitStack() as stack:
        file = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "problems.json"
        file.write_text(json.dumps(given), encoding="utf-8")
        places = {"": base, **heads}
        sides = {name: stack.enter_context(side(path, file)) for name, path in places.items()}

        def solve(number: int, repetition: int, times: int) -> None:
            found: dict[str, dict[str, Any]] = {}
            for turn in range(times):
                names = list(sides)
                shift = (repetition + number + turn) % len(names)
                for name in [*names[shift:], *names[:shift]][:: 1 if turn % 2 else -1]:
                    answer = sides[name].solve(number)
                    if name not in found or answer["cpu_s"] < found[name]["cpu_s"]:
                        found[name] = answer
            for name in heads:
                rows[name].append(_row(chosen[number], given[number][0]["model"], repetition))
                for suffix, answer in (("base", found[""]), ("head", found[name])):
                    rows[name][-1] |= {f"{key}_{suffix}": value for key, value in answer.items()}

        for number in range(len(chosen)):  # compiles or loads the kernels
            solve(number, 0, 1)
        for table in rows.values():
            table[len(COUNTED) :] = []
            for row in table:
                row |= {"cpu_s_base": np.nan, "cpu_s_head": np.nan}
        for repetition in range(MOST * repetitions):
            if repetition >= repetitions and all(map(is_precise, map(pd.DataFrame, rows.values()))):
                break
            for number in range(len(COUNTED), len(chosen)):
                solve(number, repetition, MINIMUM_OF)
    return {name: pd.DataFrame(table) for name, table in rows.items()}


def _row(problem: Problem, model: str, repetition: int) -> dict[str, Any]:
    subject, settings = problem
    shown = ", ".join(f"{name} {value}" for name, value in settings.items())
    is_default = settings.items() >= DEFAULT.items()
    group = f"{model}, default mode" if is_default else model
    return {"group": group, "problem": f"{subject}: {shown}", "repetition": repetition}


def main(
    old: Annotated[str, typer.Argument(help="A checkout of the version to compare with.")] = "",
    out: Annotated[Path, typer.Argument(help="CSV file for the times.")] = Path(
        "results/timings/times.csv"
    ),
    new: Annotated[Path, typer.Option(help="The other checkout; default: this one.")] = ROOT,
    repetitions: Annotated[int, typer.Option(min=FEWEST)] = REPETITIONS,
) -> None:
    """Measure the CPU time of two checkouts in turn, and print the verdicts."""
    if not (Path(old) / "dcreg").is_dir() or not old:
        print(f"error: OLD={old}: not a checkout; use `make timings OLD=folder`", file=sys.stderr)
        raise typer.Exit(2)
    table = measure(Path(old), {"head": new}, repetitions)["head"]
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, index=False)
    for found in judge(table):
        print(f"{found.group:<26} {found.verdict:<8} {found.summary}")
    print(out)


if __name__ == "__main__":
    typer.run(main)
