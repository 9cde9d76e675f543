"""How the verdicts changed with the hours of evidence, from the tables of all blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pandas as pd

from reports.campaign.forecast import seconds_of
from reports.ledger.book import Ledger
from reports.ledger.evidence import Evidence, plain_name
from reports.ledger.intervals import NOT_RUN, OPEN
from reports.ledger.judging import judge
from reports.tables import Tables


def verdicts(tables: Tables, book: Ledger) -> pd.DataFrame:
    """Return the verdict on each claim (rows) after 1, 2, 4, … hours of CPU and after all (columns).

    Blocks count in the order of their trials; a block that exceeds the hours does not count.
    """
    columns = {}
    for hours, part in _parts(tables):
        found = judge(book, Evidence.of_tables(part), {plain_name(tables.experiment)})
        columns[round(hours, 2)] = {each.id: each.verdict for each in found}
    table = pd.DataFrame(columns).rename_axis(index="claim", columns="hours")
    return table[(table != NOT_RUN).any(axis=1)]


def changes(table: pd.DataFrame) -> list[str]:
    """Return a line for each claim that was decided and changed its verdict afterwards."""
    found = []
    for claim, row in table.iterrows():
        steps = row[row != row.shift()]
        decided = steps[~steps.isin([NOT_RUN, OPEN])]
        if len(decided) and decided.index[0] != steps.index[-1]:
            words = ", ".join(f"{verdict} after {hours:g} h" for hours, verdict in steps.items())
            found.append(f"{claim}: {words}")
    return found


def _parts(tables: Tables) -> Iterator[tuple[float, Tables]]:
    """Yield the tables of the first blocks with their hours: 1, 2, 4, … and all."""
    runs = tables.runs
    spent = seconds_of(runs).groupby(runs["trial"]).sum().cumsum() / 3600.0
    whole, hours = float(spent.iloc[-1]), 1.0
    while hours < whole:
        if len(trials := spent.index[spent <= hours]):
            yield hours, replace(tables, runs=runs[runs["trial"].isin(trials)])
        hours *= 2.0
    yield whole, tables
