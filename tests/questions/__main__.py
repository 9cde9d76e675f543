"""``python -m tests.questions``: ask each question about small problems; all matchings give the truth.

Exit code 1 if any answer was wrong; a problem can be repeated by its number with ``--only``. ``--first``
and ``--count`` check a slice of the problems, ``--jobs`` uses several processes.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Annotated

import typer
from rich.progress import track

import dcreg
from tests.questions.checks import CHECKS, Checked
from tests.questions.draws import noisy
from tests.questions.problems import VARIANTS, small


def main(
    count: Annotated[int, typer.Option(help="problems of each question")] = 1000,
    first: Annotated[int, typer.Option(help="number of the first problem")] = 0,
    jobs: Annotated[int, typer.Option(help="processes")] = 1,
    only: Annotated[int | None, typer.Option(help="just the problem of this number")] = None,
    question: Annotated[str | None, typer.Option(help="just this question")] = None,
) -> None:
    dcreg.warm_up()
    n_wrong = 0
    for name, check in CHECKS.items():
        if question not in (None, name):
            continue
        numbers = range(first, first + count) if only is None else [only]
        began, answers = time.perf_counter(), []
        checked = zip(numbers, _in_processes(check, numbers, jobs), strict=True)
        for number, (answer, faults) in track(
            checked, name, len(numbers), disable=len(numbers) == 1
        ):
            answers.append(answer)
            for fault in faults:
                n_wrong += 1
                print(f"WRONG {name} {_described(name, number)}: {fault}")
        spent_s = time.perf_counter() - began
        print(f"{name}: {len(answers):,} problems in {spent_s:.0f} s: {dict(Counter(answers))}")
    print(f"{n_wrong} wrong statements")
    raise typer.Exit(int(n_wrong > 0))


def _described(name: str, number: int) -> str:
    """Return the problem of a question in words."""
    return str(noisy(number) if name == "covariance" else small(number, name * (name in VARIANTS)))


def _in_processes(
    check: Callable[[int], Checked], numbers: Sequence[int], jobs: int
) -> Iterator[Checked]:
    """Yield what the check of each number returns, in order."""
    if jobs == 1:
        yield from map(check, numbers)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(check, numbers)


if __name__ == "__main__":
    typer.run(main)
