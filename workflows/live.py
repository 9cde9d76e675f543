"""The state of an experiment while it runs: a table that refreshes on a terminal, lines elsewhere."""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Self

import numpy as np
import pandas as pd
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from baselines import registry
from workflows.integrity import opened
from workflows.labels import display_names
from workflows.outcomes import OUTCOMES, outcome
from workflows.outlook import duration, kept_runs, measured_times
from workflows.stages.plan import Plan
from workflows.stages.progress import Running, running

GLANCE_S = 1.0  # between two readings of the results
LINE_S = 10.0  # between two lines without a terminal, unless another share has ended
LINE_SHARE = 0.05
SHOWN = ("finished", "limited", "failed")
Cell = tuple[str, str, str]  # method, model and test


@dataclass
class State:
    """What is known about the runs of a plan, from the journals that its jobs write.

    Attributes
    ----------
    names : dict
        The displayed name of each method.
    total : Counter
        Planned runs of each method.
    ended : dict
        The outcome of each run that has ended, by its run_id.
    """

    plan: Plan
    folder: Path
    names: dict[str, str] = field(init=False)
    total: Counter[str] = field(init=False)
    ended: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.names = display_names(self.plan.experiment.methods)
        self._read = {path: path.stat().st_size for path in self._journals()}
        self._group: dict[str, Cell] = {}
        self._jobs: dict[Path, list[str]] = {}
        self._seen: dict[Path, int] = {}
        for run in self.plan.runs():
            self._group[run.run_id] = run.method.name, run.chunk.model, run.instance.test
            path = self.folder / "runs" / run.method.name / f"{run.chunk.name}.parquet"
            self._jobs.setdefault(path, []).append(run.run_id)
        self.total = Counter(method for method, _, _ in self._group.values())
        kept = kept_runs(self.plan, self.folder)
        self._times = measured_times(self.plan, self.folder, kept)
        self._present = {
            each.name: registry.fingerprint(each.baseline, options=each.options)
            for each in self.plan.methods
        }
        self.ended = {
            run_id: outcome(kept[run_id]["status"])
            for run_id, (method, _, _) in self._group.items()
            if run_id in kept and kept[run_id]["fingerprint"] == self._present[method]
        }
        self._limits = {
            each.name: self.plan.experiment.limits_of(each).time_s for each in self.plan.methods
        }

    def _journals(self) -> list[Path]:
        return sorted(self.folder.glob("runs/*/*.journal.jsonl"))

    def read(self) -> None:
        """Read the lines that were added to the journals, and which jobs have ended."""
        for path in self._journals():
            with path.open("rb") as stream:
                stream.seek(self._read.get(path, 0))
                lines = stream.read()
            whole = lines[: lines.rfind(b"\n") + 1]  # the last line may be half written
            self._read[path] = self._read.get(path, 0) + len(whole)
            for line in whole.decode("utf-8", errors="replace").splitlines():
                row = opened(line)
                if row and row["run_id"] in self._group:
                    self.ended[row["run_id"]] = outcome(row["status"])
                    times = self._times.setdefault(self._group[row["run_id"]], [])
                    times.append(row.get("time_solve_s", 0.0))
        for path in self._jobs:
            self._read_absent(path)

    def _read_absent(self, path: Path) -> None:
        """Count the runs of a job that have no line in its journal: their method is not installed."""
        if not path.is_file() or self._seen.get(path) == (stamp := path.stat().st_mtime_ns):
            return
        self._seen[path] = stamp
        if all(run_id in self.ended for run_id in self._jobs[path]):
            return
        runs = pd.read_parquet(path, columns=["run_id", "status", "fingerprint"])
        for run_id, status, fingerprint in runs.itertuples(index=False):
            if run_id in self._group and fingerprint == self._present[self._group[run_id][0]]:
                self.ended.setdefault(run_id, outcome(status))

    def counts(self) -> dict[str, Counter[str]]:
        """Count the outcomes of each method."""
        counts: dict[str, Counter[str]] = {method: Counter() for method in self.total}
        for run_id, word in self.ended.items():
            counts[self._group[run_id][0]][word] += 1
        return counts

    def seconds_left(self) -> tuple[dict[str, float], bool]:
        """Return the estimated seconds of the remaining runs per method, and whether all are measured.

        A run takes the median of its method, model and test; where none is known, the time limit.
        """
        left = Counter(group for run_id, group in self._group.items() if run_id not in self.ended)
        seconds, known = dict.fromkeys(self.total, 0.0), True
        for group, count in left.items():
            times = self._times.get(group)
            known = known and bool(times)
            seconds[group[0]] += count * (np.median(times) if times else self._limits[group[0]])
        return seconds, known


class View:
    """Shows the state of a plan in `folder` while its jobs run on `cores` cores."""

    def __init__(
        self, plan: Plan, folder: Path, cores: int, console: Console | None = None
    ) -> None:
        self.console = console or Console()
        self.is_live = self.console.is_terminal
        self._state, self._cores = State(plan, folder), cores
        self._folder = folder
        self._glanced, self._line_at = -float("inf"), time.monotonic()
        self._share = self._share_ended()
        self._live = Live(console=self.console, auto_refresh=False, transient=True)

    def __enter__(self) -> Self:
        if self.is_live:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def follow(self, output: IO[str]) -> threading.Thread:
        """Print the lines of `output` above the table, from a thread."""

        def copy() -> None:
            with output:
                for line in output:
                    self.console.print(
                        line.rstrip("\n"), markup=False, highlight=False, soft_wrap=True
                    )

        thread = threading.Thread(target=copy, daemon=True)
        thread.start()
        return thread

    def update(self) -> None:
        """Read the results, at most once per `GLANCE_S`, and show what is new."""
        now = time.monotonic()
        if now - self._glanced < GLANCE_S:
            return
        self._glanced = now
        self._state.read()
        solves = list(running(self._folder / "runs"))
        if self.is_live:
            self._live.update(Group(self._table(solves), self.summary(solves)), refresh=True)
            return
        share = self._share_ended()
        is_due = now - self._line_at >= LINE_S
        if share != self._share and (is_due or share - self._share >= LINE_SHARE):
            self._share, self._line_at = share, now
            self.console.print(
                f"progress  {self.summary(solves)}", markup=False, highlight=False, soft_wrap=True
            )

    def _share_ended(self) -> float:
        return len(self._state.ended) / max(1, self._state.total.total())

    def summary(self, solves: list[Running]) -> str:
        """Return the state in one line."""
        counts: Counter[str] = sum(self._state.counts().values(), Counter())
        words = ", ".join(f"{counts[word]} {word}" for word in OUTCOMES if counts[word])
        seconds, known = self._state.seconds_left()
        left = duration(sum(seconds.values()) / self._cores)
        total = self._state.total.total()
        now = ", ".join(self._running(each) for each in solves)
        return "; ".join(
            filter(
                None,
                [
                    f"{len(self._state.ended)} of {total} runs ended"
                    + (f" ({words})" * bool(words)),
                    now and f"running: {now}",
                    f"{'about' if known else 'at most'} {left} left",
                ],
            )
        )

    def _running(self, solve: Running) -> str:
        taken = duration(time.time() - solve.since)
        name = self._state.names.get(solve.method, solve.method)
        return f"{name} {taken}" + ("" if solve.proven is None else f", gap {_gap(solve.proven)}")

    def _table(self, solves: list[Running]) -> Table:
        """Return a row per method, those that run first; as many as the terminal has room for."""
        table = Table(box=None, pad_edge=False)
        for head in ("method", "runs", *SHOWN, "other", "running", "gap", "left"):
            table.add_column(head, justify="left" if head == "method" else "right", no_wrap=True)
        counts, (seconds, _) = self._state.counts(), self._state.seconds_left()
        busy = Counter(each.method for each in solves)
        total = self._state.total

        def rank(method: str) -> tuple[bool, bool]:
            return not busy[method], counts[method].total() == total[method]

        methods = sorted(total, key=rank)
        room = max(3, self.console.height - 6)
        for method in methods[:room]:
            known, ended = counts[method], counts[method].total()
            other = ended - sum(known[word] for word in SHOWN)
            gaps = [each.proven for each in solves if each.method == method]
            table.add_row(
                escape(self._state.names[method]),
                f"{ended}/{total[method]}",
                *(str(known[word] or "") for word in SHOWN),
                *(str(number or "") for number in (other, busy[method])),
                ", ".join(_gap(proven) for proven in gaps if proven is not None),
                duration(seconds[method]) if ended < total[method] else "",
            )
        if methods[room:]:
            table.add_row(f"… {len(methods) - room} more methods")
        return table


def _gap(proven: float) -> str:
    """Return the relative gap of a search that has proven a share."""
    return f"{100 * (1 - proven):.3g} %"
