"""``python -m tests.exact``: prove certificates of small 2D problems in integers; none may be refused.

A certificate with a lower bound of 0 is checked, but does not count. Exit code 1 if one was refused or
wrong.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from typing import Annotated

import typer
from rich.progress import Progress

from tests.exact.check import check, problems


def main(
    count: Annotated[int, typer.Option(help="certificates to prove")] = 1000,
    skip: Annotated[int, typer.Option(help="problems to skip at the beginning")] = 0,
) -> None:
    kinds: Counter[str] = Counter()
    check_s, sizes, began = 0.0, [0, 0], time.perf_counter()
    with Progress() as progress:
        task = progress.add_task("exact", total=count)
        for small in itertools.islice(problems(), skip, None):
            if kinds["proven"] == count:
                break
            kind, fault, report = check(small)
            kinds[kind] += 1
            check_s += report.time_s
            sizes = [sizes[0] + report.n_leaves, sizes[1] + report.n_boxes]
            progress.update(task, completed=kinds["proven"])
            if fault:
                print(f"WRONG {small}: {fault}")
    print(
        f"{kinds.total():,} certificates in {time.perf_counter() - began:.0f} s, of which the checks "
        f"took {check_s:.0f} s: {dict(kinds)}; {sizes[0]:,} leaves, {sizes[1]:,} boxes"
    )
    raise typer.Exit(int(kinds["wrong"] > 0))


if __name__ == "__main__":
    typer.run(main)
