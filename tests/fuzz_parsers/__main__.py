"""``python -m tests.fuzz_parsers``: give every parser changed files for some time.

A parser may read a file or refuse it by its own error. Another exception, a warning, a crash and a hang
are faults; the exit code is then 1. The files of a case depend on its number only: ``--only`` repeats it.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import re
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from random import Random
from typing import Annotated

import typer

from tests.fuzz_parsers.parsers import PARSERS, Parser

HANG_S = 60.0  # of a case, however busy the machine is
STEP_S = 0.5  # between two looks at whether it has ended
EXTRA_MEMORY = 4 * 2**30  # bytes of address space beyond what is loaded
FORK = multiprocessing.get_context("fork")


def fault_of(parser: Parser, number: int) -> tuple[str, str]:
    """Return the outcome of a case and, if it is a fault, its traceback."""
    with tempfile.TemporaryDirectory(prefix="dcreg-fuzz-") as name, warnings.catch_warnings():
        path = parser.make(Random(f"{parser.name} {number}"), Path(name))
        warnings.simplefilter("error")
        try:
            parser.read(path)
        except parser.refusals as error:
            return type(error).__name__, "" if str(error) else "the message is empty"
        except Exception as error:
            return f"fault: {type(error).__name__}", traceback.format_exc()
        return "read", ""


class Campaign:
    """The cases of one parser, in a process that may crash or hang."""

    def __init__(self, parser: Parser, first: int) -> None:
        self.parser = parser
        self.number = FORK.Value("q", first)
        self.outcomes: Counter[str] = Counter()
        self.faults: dict[str, tuple[int, str]] = {}  # the first case of each kind

    def run(self, seconds: float) -> None:
        """Try cases until the time is over; go on after a crash."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            results, far_end = FORK.Pipe(duplex=False)
            process = FORK.Process(target=self._cases, args=(far_end, end))
            process.start()
            far_end.close()
            lost = self._collect(results, process)
            if lost:
                self._count(self.number.value, f"fault: {lost}", lost)
                self.number.value += 1

    def _collect(self, results, process) -> str:
        """Count outcomes until the process ends; return how it was lost, or nothing."""
        waited = 0.0  # counted in steps: both processes may be suspended
        while True:
            if results.poll(STEP_S):
                waited = 0.0
                try:
                    self._count(*results.recv())
                except EOFError:
                    process.join()
                    return f"exit code {process.exitcode}" if process.exitcode else ""
            elif (waited := waited + STEP_S) >= HANG_S:
                process.kill()
                process.join()
                return "hangs"

    def _count(self, number: int, outcome: str, details: str) -> None:
        self.outcomes[outcome] += 1
        if details:
            place = re.sub(r"line \d+|\d+", "", "".join(details.splitlines()[-4:-1]))
            self.faults.setdefault(f"{outcome} {place}", (number, details))

    def _cases(self, far_end, end: float) -> None:
        # Loads what the parser imports: here, as a process that is forked from one with threads can hang.
        fault_of(self.parser, self.number.value)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + EXTRA_MEMORY,) * 2)
        faulthandler.enable()
        while time.monotonic() < end:
            far_end.send((self.number.value, *fault_of(self.parser, self.number.value)))
            self.number.value += 1


def main(
    minutes: Annotated[float, typer.Option(help="time for each parser")] = 10.0,
    parser: Annotated[list[str] | None, typer.Option(help="just these; default: all")] = None,
    first: Annotated[int, typer.Option(help="number of the first case")] = 0,
    only: Annotated[int | None, typer.Option(help="just the case of this number")] = None,
) -> None:
    """Give every parser changed files and count what is neither read nor refused."""
    known = {each.name: each for each in PARSERS}
    found = False
    for name in parser or known:
        if only is not None:
            print(name, *fault_of(known[name], only), sep="\n")
            continue
        campaign = Campaign(known[name], first)
        campaign.run(60 * minutes)
        for number, details in campaign.faults.values():
            print(f"{name}, case {number}:\n{details}", file=sys.stderr)
        found |= bool(campaign.faults)
        outcomes = ", ".join(f"{count} {what}" for what, count in campaign.outcomes.most_common())
        print(
            f"{name:<14} {campaign.outcomes.total():>8} files in {minutes:g} min, "
            f"{len(campaign.faults)} kinds of faults: {outcomes}",
            flush=True,
        )
    raise typer.Exit(int(found))


if __name__ == "__main__":
    typer.run(main)
