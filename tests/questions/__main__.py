"""``python -m tests.questions``: ask each question about small problems; all matchings give the truth.

Exit code 1 if any answer was wrong; a problem can be repeated by its number with ``--only``.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Annotated

import typer
from rich.progress import track

import dcreg
from tests.questions.checks import CHECKS
from tests.questions.problems import small


def main(
    count: Annotated[int, typer.Option(help="problems of each question")] = 1000,
    only: Annotated[int | None, typer.Option(help="just the problem of this number")] = None,
    question: Annotated[str | None, typer.Option(help="just this question")] = None,
) -> None:
    dcreg.warm_up()
    n_wrong = 0
    for name, check in CHECKS.items():
        if question not in (None, name):
            continue
        numbers, began, answers = range(count) if only is None else [only], time.perf_counter(), []
        for number in track(numbers, name, disable=only is not None):
            answer, faults = check(number)
            answers.append(answer)
            for fault in faults:
                n_wrong += 1
                print(f"WRONG {name} {small(number, with_range=name == 'range')}: {fault}")
        spent_s = time.perf_counter() - began
        print(f"{name}: {len(answers):,} problems in {spent_s:.0f} s: {dict(Counter(answers))}")
    print(f"{n_wrong} wrong statements")
    raise typer.Exit(int(n_wrong > 0))


if __name__ == "__main__":
    typer.run(main)
