"""Run one block after the other until the time is over or nothing is left to decide."""

from __future__ import annotations

import csv
import os
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from rich.console import Console
from rich.table import Table

from baselines import registry
from reports.campaign.choice import Option, options
from reports.campaign.forecast import Forecast, Times, bytes_per_run
from reports.ledger.book import Ledger, ledger
from reports.ledger.evidence import Evidence, plain_name
from reports.ledger.judging import Judgement, judge
from reports.tables import Tables
from workflows.archives import archived, folders, runs_of, runs_of_others
from workflows.blocks import EVIDENCE, NEEDS, Needs
from workflows.compose import QUICK
from workflows.config import Experiment, load, origin
from workflows.live import View
from workflows.outcomes import NOT_NEEDED
from workflows.running import INTERRUPTED, run_snakemake
from workflows.stages.plan import Plan, expand

LOG = "forecast.csv"  # of all blocks: forecast and actual time


@dataclass(frozen=True)
class Campaign:
    """The state of one experiment: its needs, tables and verdicts.

    Attributes
    ----------
    name : str
        Of the experiment, as in `python -m workflows run`.
    directory : Path
        Folder that contains ``results/``.
    """

    name: str
    directory: Path

    @cached_property
    def experiment(self) -> Experiment:
        return load(self.name)

    @property
    def folder(self) -> Path:
        return self.directory / "results" / self.experiment.name / EVIDENCE

    @property
    def needs_path(self) -> Path:
        return self.folder / NEEDS

    @property
    def trials(self) -> int:
        """Trials of the config, which no block exceeds."""
        return max(entry.trials for entry in self.experiment.datasets)

    def adopt(self) -> None:
        """Continue from the blocks of the latest archive that has some, if there are none here."""
        if self.needs_path.is_file():
            return
        for archive in reversed(folders()):
            stored = archive / "experiments" / self.experiment.name / NEEDS
            if stored.is_file():
                Needs.read(stored).write(self.needs_path)
                return

    def plan(self) -> Plan:
        """Return the plan of all blocks so far."""
        needs = Needs.read(self.needs_path) if self.needs_path.is_file() else Needs({})
        return expand(self.experiment, None, origin(self.name), needs)

    def tables(self) -> Tables | None:
        """Return the tables of the finished blocks; None before the first one."""
        path = self.folder / "tables"
        return Tables.load(path) if (path / "accounting.csv").is_file() else None

    def judged(self, book: Ledger) -> list[Judgement]:
        """Return the verdicts on the claims about this experiment."""
        tables = self.tables()
        evidence = Evidence.of_tables(tables) if tables else Evidence({}, {})
        return judge(book, evidence, {plain_name(self.experiment.name)})

    def times(self) -> Times:
        """Return the times of finished runs, else of archived ones, else of the quick part.

        Archived runs of other experiments are known as well, as other tests.
        """
        tables = self.tables()
        quick = self.folder.parent.with_name(f"{self.experiment.name}{QUICK}") / "tables"
        known = [] if tables is None else [tables.runs]
        if (stored := runs_of(self.experiment.name)) is not None:
            known.append(stored)
        if (quick / "accounting.csv").is_file():
            known.append(Times.as_limited(Tables.load(quick).runs, self.experiment))
        if (others := runs_of_others(self.experiment.name)) is not None:
            known.append(others.assign(test=others["experiment"] + " " + others["test"]))
        own = None if tables is None else int((tables.runs["outcome"] != NOT_NEEDED).sum())
        measured = bytes_per_run(self.folder.parent, own) if own else None
        return Times.of(known, self.experiment, measured)

    def unfinished(self) -> Forecast:
        """Return the forecast of the needed runs without a result, here or in an archive."""
        tables = self.tables()
        done = set() if tables is None else set(tables.runs["run_id"])
        for method in self.experiment.methods:
            version = registry.fingerprint(method.baseline)
            done |= {run_id for run_id, _, known in archived(method.name) if known == version}
        return self.times().of_runs(run for run in self.plan().runs() if run.run_id not in done)


def collect(
    hours: float, names: Sequence[str], directory: Path, cores: int, out: Path
) -> list[Option]:
    """Run blocks for at most `hours`; return what is left to decide.

    Parameters
    ----------
    hours : float
    names : sequence of str
        Experiments.
    directory : Path
        Folder that contains ``results/``.
    cores : int
    out : Path
        Folder for the log of forecasts and the measured times.
    """
    book, console = ledger(), Console()
    campaigns = {name: Campaign(name, directory) for name in names}
    end = time.monotonic() + 3600.0 * hours
    may_go_on = _finish_blocks(campaigns.values(), end, cores, out, console)
    ahead = _ahead(book, campaigns)
    while may_go_on:
        left_s = end - time.monotonic()
        fitting = [
            (name, option)
            for name, option in ahead
            if not option.obstacle and option.step.seconds <= left_s * cores
        ]
        if not fitting:
            break
        name, option = fitting[0]
        option.needs.write(campaigns[name].needs_path)
        may_go_on = _run(campaigns[name], option.claim, option.step, end, cores, out, console)
        ahead = _ahead(book, campaigns)
    for name, campaign in campaigns.items():
        out.mkdir(parents=True, exist_ok=True)
        campaign.times().cells.round(4).to_csv(out / f"{name}.times.csv")
    _print(console, book, campaigns, [option for _, option in ahead])
    return [option for _, option in ahead]


def _finish_blocks(
    campaigns: Iterable[Campaign], end: float, cores: int, out: Path, console: Console
) -> bool:
    """Finish the blocks of earlier calls; return whether all of them ended before `end`."""
    for campaign in campaigns:
        campaign.adopt()
        rest = campaign.unfinished()
        is_begun = campaign.needs_path.is_file() and campaign.tables() is None
        if (rest.runs or is_begun) and not _run(
            campaign, "continue", rest, end, cores, out, console
        ):
            return False
    return True


def _ahead(book: Ledger, campaigns: dict[str, Campaign]) -> list[tuple[str, Option]]:
    """Return the open claims of all experiments, the one expected to be decided first at the front."""
    found = [
        (name, option)
        for name, campaign in campaigns.items()
        for option in options(
            book, campaign.judged(book), campaign.plan(), campaign.times(), campaign.trials
        )
    ]
    return sorted(found, key=lambda each: (bool(each[1].obstacle), each[1].seconds, each[1].claim))


def _run(
    campaign: Campaign,
    claim: str,
    expected: Forecast,
    end: float,
    cores: int,
    out: Path,
    console: Console,
) -> bool:
    """Run the needed blocks of an experiment; return whether they ended before `end`."""
    console.print(f"block     {campaign.name}, {claim}: {expected}", soft_wrap=True)
    before = campaign.tables()
    known = set() if before is None else set(before.runs["run_id"])
    began = time.monotonic()
    arguments = [
        "tables", "--cores", str(cores), "--resources", "fetching=1",
        "--config", f"experiment={campaign.name}", f"needs={campaign.needs_path.resolve()}",
    ]  # fmt: skip
    with _interrupted_at(end):
        code = run_snakemake(
            campaign.directory,
            campaign.experiment.name,
            arguments,
            view_of=lambda: View(campaign.plan(), campaign.folder.parent, cores, console),
        )
    after = campaign.tables()
    if code or after is None:
        what = "the time is over" if code == INTERRUPTED else "some stages failed; see above"
        console.print(f"stopped   {what}; the same command continues from here")
        return False
    new = after.runs[~after.runs["run_id"].isin(known) & (after.runs["outcome"] != NOT_NEEDED)]
    actual = float((new["time_solve_s"] + new["time_overhead_s"].fillna(0.0)).sum())
    _append(
        out / LOG,
        {
            "experiment": campaign.experiment.name, "claim": claim, "runs": len(new),
            "unseen": expected.unseen, "forecast_s": round(expected.seconds, 1),
            "actual_s": round(actual, 1), "wall_s": round(time.monotonic() - began, 1),
            "forecast_mb": expected.megabytes,
        },
    )  # fmt: skip
    console.print(f"          took {actual / 60:.0f} min of CPU")
    return True


@contextmanager
def _interrupted_at(end: float) -> Iterator[None]:
    """Send this process SIGTERM at `end`, at which Snakemake and its jobs end in order."""
    timer = threading.Timer(
        max(0.0, end - time.monotonic()), os.kill, (os.getpid(), signal.SIGTERM)
    )
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _append(path: Path, row: dict[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    is_new = not path.is_file()
    with path.open("a", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(row))
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def _print(
    console: Console, book: Ledger, campaigns: dict[str, Campaign], ahead: Sequence[Option]
) -> None:
    """Print the verdicts, and what the open claims need."""
    by_claim = {option.claim: option for option in ahead}
    table = Table("claim", "verdict", "further blocks", "hours of CPU", "obstacle")
    for campaign in campaigns.values():
        for found in campaign.judged(book):
            row = [found.id, found.verdict]
            if option := by_claim.get(found.id):
                row += [str(option.blocks), f"{option.seconds / 3600:.1f}", option.obstacle]
            table.add_row(*row)
    console.print(table)
