"""Verdicts as a function of the run time spent, from the step in which each run ended.

The file `STEPS` has a row per run: its ``run_id`` and the number of the step in which it ended. A run
taken from an archive may be listed again; its first step counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd

from dcreg.files import whole_file
from reports.campaign.forecast import seconds_of
from reports.ledger.book import Ledger
from reports.ledger.evidence import Evidence, plain_name
from reports.ledger.intervals import NOT_RUN, OPEN
from reports.ledger.judging import judge
from reports.tables import Tables
from workflows.outcomes import NOT_NEEDED

STEPS = "steps.csv"
# Hours of run time at which verdicts are listed, in addition to the final ones.
HOURS = 1, 2, 4, 8, 12, 16, 24, 32, 48, 64, 96, 128


def record(path: Path, run_ids: Iterable[str]) -> None:
    """Add a step with the runs that ended in it."""
    known = _read(path)
    step = int(known["step"].max()) + 1 if len(known) else 0
    new = pd.DataFrame({"run_id": list(run_ids), "step": step})
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        pd.concat([known, new]).to_csv(part, index=False)


def record_rest(path: Path, ended: Iterable[str]) -> None:
    """Add a step with the runs that have none, such as those of a call that was killed."""
    known = set(_read(path)["run_id"])
    if rest := [run_id for run_id in dict.fromkeys(ended) if run_id not in known]:
        record(path, rest)


def verdicts(tables: Mapping[str, Tables], steps: Path, book: Ledger) -> pd.DataFrame:
    """Return the verdict on each claim (rows) after some hours of run time and after all (columns).

    The hours are those of all experiments together, at the end of the first step that reaches each of
    `HOURS`. The present rule judges the runs that had ended then. Runs without a
    recorded step form one last step.
    """
    columns = {}
    for hours, parts in _parts(tables, _read(steps)):
        columns[round(hours, 2)] = {
            each.id: each.verdict
            for name, part in parts.items()
            for each in judge(book, Evidence.of_tables(part), {plain_name(name)})
        }
    table = pd.DataFrame(columns).rename_axis(index="claim", columns="hours")
    table = table.fillna(NOT_RUN)  # no run of the experiment had ended
    return table[(table != NOT_RUN).any(axis=1)]


def changes(table: pd.DataFrame) -> list[str]:
    """Return a line for each claim that was decided and changed its verdict afterwards."""
    found = []
    for claim, row in table.iterrows():
        steps = row[row != row.shift()]
        decided = steps[~steps.isin([NOT_RUN, OPEN])]
        if len(decided) and decided.index[0] != steps.index[-1]:
            words = ", ".join(
                f"{verdict} after {hours:g} h of runs" for hours, verdict in steps.items()
            )
            found.append(f"{claim}: {words}")
    return found


def _read(path: Path) -> pd.DataFrame:
    columns = {"run_id": str, "step": int}
    return (
        pd.read_csv(path, dtype=columns) if path.is_file() else pd.DataFrame(columns=list(columns))
    )


def _parts(
    tables: Mapping[str, Tables], steps: pd.DataFrame
) -> Iterator[tuple[float, dict[str, Tables]]]:
    """Yield the hours of run time and the tables at each listed step."""
    step_of = steps.drop_duplicates("run_id").set_index("run_id")["step"]
    last = int(step_of.max()) + 1 if len(step_of) else 0
    at = {name: own.runs["run_id"].map(step_of).fillna(last) for name, own in tables.items()}
    spent = [seconds_of(own.runs).groupby(at[name]).sum() for name, own in tables.items()]
    hours = pd.concat(spent).groupby(level=0).sum().cumsum() / 3600.0
    reached = [hours.index[hours >= goal] for goal in HOURS]
    for step in sorted({each[0] for each in reached if len(each)} | {hours.index[-1]}):
        parts = {}
        for name, own in tables.items():
            has_ended = (at[name] <= step) & (own.runs["outcome"] != NOT_NEEDED)
            if has_ended.any():
                kept = has_ended | (own.runs["outcome"] == NOT_NEEDED)
                parts[name] = replace(own, runs=own.runs[kept])
        yield float(hours[step]), parts
