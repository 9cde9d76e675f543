"""Run one block after the other until the time is over or nothing is left to decide."""

from __future__ import annotations

import csv
import functools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from rich.console import Console
from rich.table import Table

from baselines import registry
from reports.archive.read import restore
from reports.campaign.choice import Option, options
from reports.campaign.forecast import TIMED, Forecast, Pair, Times, bytes_per_run, seconds_of
from reports.campaign.growth import changes, verdicts
from reports.campaign.pilot import PILOTS, begun, pilots, store, unmeasured
from reports.ledger.book import Ledger, ledger
from reports.ledger.evidence import Evidence, plain_name
from reports.ledger.judging import Judgement, judge
from reports.tables import Tables
from workflows.archives import archived, folders, runs_of, runs_of_others
from workflows.blocks import EVIDENCE, NEEDS, Needs
from workflows.compose import QUICK, ConfigError
from workflows.config import Experiment, Selection, load, origin
from workflows.journal import journalled
from workflows.live import View
from workflows.outcomes import NOT_NEEDED, main_machine
from workflows.provenance import machine_card
from workflows.running import INTERRUPTED, run_snakemake
from workflows.stages.plan import InstanceSpec, Plan, expand, method_identity, run_identity

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
    def pilots_path(self) -> Path:
        return self.folder / PILOTS

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
                self._adopt_tables(archive)
                Needs.read(stored).write(self.needs_path)
                return

    def _adopt_tables(self, archive: Path) -> None:
        if (self.folder / "tables").exists():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=self.folder) as place:
            (tables,) = restore(archive, Path(place), only=self.experiment.name)
            tables.rename(self.folder / "tables")

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
        known = [self.ended(), self.archived_runs]
        if (quick / "accounting.csv").is_file():
            known.append(Times.as_limited(Tables.load(quick).runs, self.experiment))
        if (others := runs_of_others(self.experiment.name)) is not None:
            known.append(others.assign(test=others["experiment"] + " " + others["test"]))
        own = None if tables is None else int((tables.runs["outcome"] != NOT_NEEDED).sum())
        measured = bytes_per_run(self.folder.parent, own) if own else None
        return Times.of(known, self.experiment, measured)

    @cached_property
    def versions(self) -> dict[str, str]:
        """The present versions of the methods."""
        methods = self.experiment.methods
        return {method.name: registry.fingerprint(method.baseline) for method in methods}

    @cached_property
    def specs(self) -> dict[str, InstanceSpec]:
        """All instances of the experiment by their instance_id."""
        chunks = expand(self.experiment).chunks
        return {spec.instance_id: spec for chunk in chunks for spec in chunk.instances}

    @cached_property
    def archived_runs(self) -> pd.DataFrame:
        """The runs in the latest archive that has some."""
        runs = runs_of(self.experiment.name)
        return pd.DataFrame(columns=["run_id", *TIMED]) if runs is None else runs

    def ended(self) -> pd.DataFrame:
        """Return method, test, level and seconds of ended runs, also of an interrupted block.

        Runs of earlier versions of a method are left out.
        """
        rows = []
        for method in self.experiment.methods:
            identity = method_identity(self.experiment, method)
            for row in journalled(self.folder.parent / "runs" / method.name).values():
                spec = self.specs.get(row["instance_id"])
                if spec is None or row["fingerprint"] != self.versions[method.name]:
                    continue
                if row["run_id"] == run_identity(identity, spec.instance_id):
                    seconds = row.get("time_solve_s"), row.get("time_overhead_s")
                    rows.append((row["run_id"], method.name, spec.test, spec.level, *seconds))
        return pd.DataFrame(rows, columns=["run_id", *TIMED])

    @cached_property
    def archived_ids(self) -> set[str]:
        """The run_ids of archived runs of the present versions of the methods."""
        return {
            run_id
            for name, present in self.versions.items()
            for run_id, _, version in archived(name)
            if version == present
        }

    def shown(self) -> set[str]:
        """Return the run_ids of the results in the tables, of the present versions of the methods."""
        if (tables := self.tables()) is None:
            return set()
        runs = tables.runs[tables.runs["outcome"] != NOT_NEEDED]
        return set(runs.loc[runs["fingerprint"] == runs["method"].map(self.versions), "run_id"])

    def done(self) -> set[str]:
        """Return the run_ids of all results, also of an interrupted block or a pilot."""
        return self.shown() | set(self.ended()["run_id"]) | self.archived_ids

    def is_behind(self) -> bool:
        """Tell whether the tables lack needed runs, which may have ended."""
        shown = self.shown()
        return any(run.run_id not in shown for run in self.plan().runs())

    def forecast(self, plan: Plan) -> Forecast:
        """Return the forecast of the needed runs of a plan without a result, here or in an archive."""
        done = self.done()
        return self.times().of_runs(run for run in plan.runs() if run.run_id not in done)


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
    for name, campaign in campaigns.items():
        _check(name, campaign.experiment)
        campaign.adopt()
        _note_machine(campaign, console)
    end = time.monotonic() + 3600.0 * hours
    run = functools.partial(_run, end=end, cores=cores, out=out, console=console)
    may_go_on = _finish_blocks(campaigns.values(), run)
    ahead = _ahead(book, campaigns)
    # by a pilot; a method that fails remains unmeasured
    tried: dict[str, set[Pair]] = {name: set() for name in names}
    while may_go_on and (chosen := _next(ahead, end - time.monotonic())):
        name, option = chosen
        campaign = campaigns[name]
        if pairs := [pair for pair in unmeasured(option.step) if pair not in tried[name]]:
            tried[name].update(pairs)
            parts = list(pilots(pairs, campaign.experiment, option.needs))
            store(parts, campaign.pilots_path)
            may_go_on = _run_pilots(campaign, option.claim, run)
        else:
            option.needs.write(campaign.needs_path)
            may_go_on = run(campaign, option.claim, option.step)
        ahead = _ahead(book, campaigns)
    for name, campaign in campaigns.items():
        out.mkdir(parents=True, exist_ok=True)
        campaign.times().cells.round(4).to_csv(out / f"{name}.times.csv")
        if (tables := campaign.tables()) is not None:
            table = verdicts(tables, book)
            table.to_csv(out / f"{name}.verdicts.csv")
            for line in changes(table):
                console.print(f"changed   {line}", soft_wrap=True)
    _print(console, book, campaigns, [option for _, option in ahead])
    return [option for _, option in ahead]


def _check(name: str, experiment: Experiment) -> None:
    """Refuse an experiment whose blocks are not known from its config."""
    for entry in experiment.datasets:
        if not entry.shapes:
            raise ConfigError(
                f"--experiments {name}: dataset {entry.dataset} has no list of shapes in the config; "
                "state its shapes, as paper2d does"
            )


def _note_machine(campaign: Campaign, console: Console) -> None:
    """Say if times of runs on this machine will not be compared."""
    tables = campaign.tables()
    if tables and main_machine(tables.runs) not in ("", machine_card()["machine_id"]):
        text = "most runs are from another machine, so claims ignore times measured on this one"
        console.print(f"times     {campaign.name}: {text}", soft_wrap=True)


def _next(ahead: Sequence[tuple[str, Option]], left_s: float) -> tuple[str, Option] | None:
    """Return the first option that more blocks help; None once no time is left.

    The order ignores the time left, so it is the same however the calls are split.
    """
    helping = (each for each in ahead if each[1].helps)
    return next(helping, None) if left_s > 0.0 else None


def _finish_blocks(campaigns: Iterable[Campaign], run: Callable[..., bool]) -> bool:
    """Finish pilots and blocks of earlier calls; return whether all of them ended in time."""
    for campaign in campaigns:
        if not _run_pilots(campaign, "resumed", run):
            return False
        if campaign.is_behind() and not run(
            campaign, "resumed", campaign.forecast(campaign.plan())
        ):
            return False
    return True


def _run_pilots(campaign: Campaign, claim: str, run: Callable[..., bool]) -> bool:
    """Run the stored pilots; return whether they ended in time."""
    for part in begun(campaign.pilots_path):
        rest = campaign.forecast(expand(campaign.experiment, part))
        if rest.runs and not run(campaign, claim, rest, part):
            return False
    campaign.pilots_path.unlink(missing_ok=True)
    return True


def _ahead(book: Ledger, campaigns: dict[str, Campaign]) -> list[tuple[str, Option]]:
    """Return the open claims of all experiments, the one expected to be decided first at the front."""
    found = []
    for name, campaign in campaigns.items():
        judged, plan, times = campaign.judged(book), campaign.plan(), campaign.times()
        of_claims = options(book, judged, plan, times, campaign.trials, campaign.done())
        found += [(name, option) for option in of_claims]
    return sorted(found, key=lambda each: each[1].rank)


def _run(
    campaign: Campaign,
    claim: str,
    expected: Forecast,
    part: Selection | None = None,
    *,
    end: float,
    cores: int,
    out: Path,
    console: Console,
) -> bool:
    """Run the needed blocks of an experiment, or a pilot; return whether they ended before `end`."""
    title = f"{claim}, pilot" if part else claim
    console.print(f"block     {campaign.name}, {title}: {expected}", soft_wrap=True)
    if time.monotonic() >= end:
        return _stopped(INTERRUPTED, end, console)
    before, began = set(campaign.ended()["run_id"]), time.monotonic()
    plan = expand(campaign.experiment, part, origin(campaign.name)) if part else campaign.plan()
    code = run_snakemake(
        campaign.directory,
        campaign.experiment.name,
        [*_targets(campaign, plan), "--cores", str(cores), "--resources", "fetching=1",
         "--config", f"experiment={campaign.name}", *_settings(campaign, part)],
        view_of=lambda: View(plan, campaign.folder.parent, cores, console),
        end=end,
    )  # fmt: skip
    if code or not (part or campaign.tables()):
        return _stopped(code, end, console)
    ended = campaign.ended()
    new = ended[~ended["run_id"].isin(before)]
    actual = float(seconds_of(new).sum())
    _append(
        out / LOG,
        {
            "experiment": campaign.experiment.name, "claim": title, "runs": len(new),
            "unseen": expected.unseen, "forecast_s": round(expected.seconds, 1),
            "actual_s": round(actual, 1), "wall_s": round(time.monotonic() - began, 1),
            "forecast_mb": expected.megabytes,
        },
    )  # fmt: skip
    console.print(f"          took {actual / 60:.0f} min of CPU")
    return True


def _stopped(code: int, end: float, console: Console) -> bool:
    """Print why nothing more is begun."""
    what = "some stages failed; see above"
    if code == INTERRUPTED:
        what = "the time is over" if time.monotonic() >= end else "interrupted"
    console.print(f"stopped   {what}; the same command continues from here")
    return False


def _targets(campaign: Campaign, plan: Plan) -> list[str]:
    """Return what Snakemake makes: the tables of all blocks, or just the runs of a pilot."""
    if plan.needs is not None:
        return ["tables"]
    runs = f"results/{campaign.experiment.name}/runs"
    return [f"{runs}/{method.name}/{chunk.name}.parquet" for method, chunk in plan.jobs()]


def _settings(campaign: Campaign, part: Selection | None) -> list[str]:
    if part is None:
        return [f"needs={campaign.needs_path.resolve()}"]
    axes = (f"{axis}={','.join(map(str, values))}" for axis, values in part if values)
    return [f"select={' '.join(axes)}"]


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
    table = Table("claim", "verdict", "hours of CPU", "obstacle")
    for campaign in campaigns.values():
        for found in campaign.judged(book):
            row = [found.id, found.verdict]
            if option := by_claim.get(found.id):
                row += [f"{option.seconds / 3600:.1f}", option.obstacle]
            table.add_row(*row)
    console.print(table)
    if chosen := next((option for option in ahead if option.helps), None):
        console.print(f"next      {chosen.claim}: {chosen.comparison}", soft_wrap=True)
