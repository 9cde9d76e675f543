"""Run one block after the other until the time is over or nothing is left to decide."""

from __future__ import annotations

import functools
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.table import Table

from dcreg.files import whole_file
from reports.campaign.campaign import Campaign
from reports.campaign.choice import Option, options
from reports.campaign.forecast import Forecast, Pair, seconds_of
from reports.campaign.growth import STEPS, changes, record, record_rest, verdicts
from reports.campaign.pilot import begun, pilots, store, unmeasured
from reports.ledger.book import Ledger, ledger
from reports.ledger.evidence import plain_name
from workflows.archives import folders
from workflows.blocks import EVIDENCE, FORECASTS, NEEDS, OPEN_CLAIMS, RUN_HOURS, VERDICTS
from workflows.compose import ConfigError
from workflows.config import Experiment, Selection, origin
from workflows.live import View
from workflows.outcomes import STARTED, main_machine
from workflows.provenance import machine_card
from workflows.running import INTERRUPTED, run_snakemake
from workflows.stages.plan import Plan, expand


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
    _adopt_logs(out)
    others = _others(names, directory)
    if hours > 0.0:
        record_rest(out / STEPS, _started([*campaigns.values(), *others.values()]))
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
    left = [option for _, option in ahead]
    rest = [option for _, option in _ahead(book, others)]
    _write(out, book, campaigns | others, left + rest, console)
    return left


def _others(names: Sequence[str], directory: Path) -> dict[str, Campaign]:
    """Return the other experiments with archived evidence, which the written tables must not lose."""
    known = {plain_name(name) for name in names}
    latest = folders()[-1:]
    stored = [path.parent.name for at in latest for path in at.glob(f"experiments/*/{NEEDS}")]
    others = {
        name: Campaign(name, directory) for name in sorted(stored) if plain_name(name) not in known
    }
    for campaign in others.values():
        campaign.adopt()
    return others


def _started(campaigns: Iterable[Campaign]) -> Iterator[str]:
    """Yield the runs that have ended, here or before they were archived."""
    for campaign in campaigns:
        yield from campaign.ended()["run_id"]
        if (tables := campaign.tables()) is not None:
            yield from tables.runs.loc[tables.runs["outcome"].isin(STARTED), "run_id"]


def _adopt_logs(out: Path) -> None:
    """Continue the logs of the latest archive, if there are none here."""
    for name in (FORECASTS, STEPS):
        stored = [folder / EVIDENCE / name for folder in folders()]
        stored = [path for path in stored if path.is_file()]
        if stored and not (out / name).exists():
            out.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(stored[-1], out / name)


def _write(
    out: Path,
    book: Ledger,
    campaigns: dict[str, Campaign],
    left: Sequence[Option],
    console: Console,
) -> None:
    """Write the times, what open claims need, and the verdicts over time; print the latter two."""
    out.mkdir(parents=True, exist_ok=True)
    for name, campaign in campaigns.items():
        campaign.times().cells.round(4).to_csv(out / f"{name}.times.csv")
    tables = {name: own for name, each in campaigns.items() if (own := each.tables()) is not None}
    if tables:
        table = verdicts(tables, out / STEPS, book)
        table.to_csv(out / VERDICTS)
        for line in changes(table):
            console.print(f"changed   {line}", soft_wrap=True)
    needs = _needs(book, campaigns, left)
    needs.to_csv(out / OPEN_CLAIMS, index=False)
    _print(console, needs, left)


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
    console.print(f"step      {campaign.name}, {title}: {expected}", soft_wrap=True)
    if time.monotonic() >= end:
        return _stopped(INTERRUPTED, end, console)
    before, began = set(campaign.ended()["run_id"]), time.monotonic()
    bytes_before = campaign.bytes_of_runs()
    plan = expand(campaign.experiment, part, origin(campaign.name)) if part else campaign.plan()
    code = run_snakemake(
        campaign.directory,
        campaign.experiment.name,
        [*_targets(campaign, plan), "--cores", str(cores), "--resources", "fetching=1",
         "--config", f"experiment={campaign.name}", *_settings(campaign, part)],
        view_of=lambda: View(plan, campaign.folder.parent, cores, console),
        end=end,
        plan=plan,
    )  # fmt: skip
    has_ended = not code and bool(part or campaign.tables())
    ended = campaign.ended()
    new = ended[~ended["run_id"].isin(before)]
    actual = float(seconds_of(new).sum())
    record(out / STEPS, new["run_id"])
    _append(
        out / FORECASTS,
        {
            "experiment": campaign.experiment.name, "claim": title, "runs": len(new),
            "planned": expected.runs, "unseen": expected.unseen,
            "forecast_s": round(expected.seconds, 1), "actual_s": round(actual, 1),
            "wall_s": round(time.monotonic() - began, 1), "forecast_mb": expected.megabytes,
            "actual_mb": (campaign.bytes_of_runs() - bytes_before) / 1e6,
        },
    )  # fmt: skip
    console.print(f"          took {actual / 60:.0f} min of run time")
    if has_ended and not part and campaign.is_behind():
        console.print(
            "stopped   the tables lack runs of this step, so it would be chosen again: look for failed "
            "stages above"
        )
        return False
    return has_ended or _stopped(code, end, console)


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
        # tables from an archive, without the runs behind them, are up to date to Snakemake
        return ["tables", "--forcerun", "aggregate"]
    runs = f"results/{campaign.experiment.name}/runs"
    return [f"{runs}/{method.name}/{chunk.name}.parquet" for method, chunk in plan.jobs()]


def _settings(campaign: Campaign, part: Selection | None) -> list[str]:
    if part is None:
        return [f"needs={campaign.needs_path.resolve()}"]
    axes = (f"{axis}={','.join(map(str, values))}" for axis, values in part if values)
    return [f"select={' '.join(axes)}"]


def _append(path: Path, row: dict[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    known = [pd.read_csv(path)] if path.is_file() else []
    with whole_file(path) as part:
        pd.concat([*known, pd.DataFrame([row])]).to_csv(part, index=False)


def _needs(book: Ledger, campaigns: dict[str, Campaign], left: Sequence[Option]) -> pd.DataFrame:
    """Return verdicts, and of open claims the expected hours of run time and the obstacle."""
    by_claim = {option.claim: option for option in left}
    rows: list[tuple[str, str, float | None, str]] = []
    for campaign in campaigns.values():
        for found in campaign.judged(book):
            option = by_claim.get(found.id)
            hours = round(option.seconds / 3600.0, 1) if option else None
            rows.append((found.id, found.verdict, hours, option.obstacle if option else ""))
    known = {name for name, *_ in rows}
    for claim in book.claims:
        if claim.id not in known and not claim.unjudged:
            command = book.commands[claim.experiment]
            rows.append((claim.id, "", None, f"outside these experiments: {command}"))
    return pd.DataFrame(rows, columns=["claim", "verdict", RUN_HOURS, "obstacle"])


def _print(console: Console, needs: pd.DataFrame, left: Sequence[Option]) -> None:
    """Print the verdicts, and what the open claims need."""
    table = Table(*needs.columns)
    for row in needs.fillna("").astype(str).itertuples(index=False):
        table.add_row(*row)
    console.print(table)
    if chosen := next((option for option in left if option.helps), None):
        console.print(f"next      {chosen.claim}: {chosen.comparison}", soft_wrap=True)
