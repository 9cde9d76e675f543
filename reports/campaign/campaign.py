"""One experiment of a campaign: what ran so far, what it takes, and what is still open."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from baselines import registry
from reports.archive.read import restore
from reports.campaign.forecast import TIMED, Forecast, Times, bytes_of
from reports.campaign.pilot import PILOTS
from reports.ledger.book import Ledger
from reports.ledger.evidence import Evidence, plain_name
from reports.ledger.judging import Judgement, judge
from reports.tables import Tables
from workflows.archives import archived, folders, runs_of, runs_of_others
from workflows.blocks import EVIDENCE, NEEDS, Needs
from workflows.compose import QUICK
from workflows.config import Experiment, load, origin
from workflows.journal import journalled
from workflows.outcomes import NOT_NEEDED
from workflows.provenance import machine_card
from workflows.stages.plan import InstanceSpec, Plan, expand, method_identity, run_identity


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

    def bytes_of_runs(self) -> int:
        """Return the disk space of runs, instances and plans, without that of the tables."""
        return bytes_of(self.folder.parent) - bytes_of(self.folder)

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

        Those of this machine come before those of others. Archived runs of other experiments are known as
        well, as other tests.
        """
        quick = self.folder.parent.with_name(f"{self.experiment.name}{QUICK}") / "tables"
        known = [self.ended(), self.archived_runs]
        if (quick / "accounting.csv").is_file():
            known.append(Times.as_limited(Tables.load(quick).runs, self.experiment))
        if (others := runs_of_others(self.experiment.name)) is not None:
            known.append(others.assign(test=others["experiment"] + " " + others["test"]))
        here = machine_card()["machine_id"]
        known = [part for runs in known for part in _by_machine(runs, here)]
        own = len(self.ended())  # adopted runs have no files here
        measured = self.bytes_of_runs() / own if own else None
        return Times.of(known, self.experiment, measured)

    @cached_property
    def versions(self) -> dict[str, str]:
        """The present versions of the methods."""
        methods = self.experiment.methods
        return {
            method.name: registry.fingerprint(method.baseline, options=method.options)
            for method in methods
        }

    @cached_property
    def specs(self) -> dict[str, InstanceSpec]:
        """All instances of the experiment by their instance_id."""
        chunks = expand(self.experiment).chunks
        return {spec.instance_id: spec for chunk in chunks for spec in chunk.instances}

    @cached_property
    def archived_runs(self) -> pd.DataFrame:
        """The runs in the latest archive that has some."""
        runs = runs_of(self.experiment.name)
        return pd.DataFrame(columns=["run_id", *TIMED, "machine_id"]) if runs is None else runs

    def ended(self) -> pd.DataFrame:
        """Return method, test, level, seconds and machine of ended runs, also of an interrupted block.

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
                    place = method.name, spec.test, spec.level
                    rows.append((row["run_id"], *place, *seconds, row["machine_id"]))
        return pd.DataFrame(rows, columns=["run_id", *TIMED, "machine_id"])

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


def _by_machine(runs: pd.DataFrame, machine_id: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Divide runs into those of a machine and those of all others."""
    here = runs["machine_id"] == machine_id
    return runs[here], runs[~here]
