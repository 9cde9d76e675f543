"""``python -m tests.exact``: prove certificates of small 2D problems in integers; none may be refused.

Exit code 1 if one was refused or wrong; its problem can be repeated by its number with ``--only``.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Annotated

import typer
from rich.progress import track

import dcreg
from tests.exact.check import check, drawn


def main(
    count: Annotated[int, typer.Option(help="certificates to prove")] = 1000,
    only: Annotated[int | None, typer.Option(help="just the problem of this number")] = None,
) -> None:
    dcreg.warm_up()
    numbers, began = range(count) if only is None else [only], time.perf_counter()
    outcomes = []
    for number in track(numbers, "exact", disable=only is not None):
        outcomes.append(check(number))
        if outcomes[-1].fault:
            print(f"WRONG {number}: {drawn(number)}: {outcomes[-1].fault}")
    kinds = Counter(outcome.kind or "wrong" for outcome in outcomes)
    reports = [outcome.report for outcome in outcomes]
    print(
        f"{len(outcomes):,} certificates in {time.perf_counter() - began:.0f} s, of which the checks "
        f"took {sum(report.time_s for report in reports):.0f} s: {dict(kinds)}; "
        f"{sum(report.n_leaves for report in reports):,} leaves, "
        f"{sum(report.n_boxes for report in reports):,} boxes"
    )
    raise typer.Exit(int(kinds["wrong"] > 0))


if __name__ == "__main__":
    typer.run(main)
