"""What solve jobs need on a cluster: memory, minutes, threads, and how many of them share a job.

The values are measured where tables of runs exist. Otherwise they follow from the experiment's limits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

from workflows.archives import runs_of
from workflows.blocks import EVIDENCE
from workflows.compose import QUICK
from workflows.config import Experiment, LimitSettings
from workflows.integrity import is_damaged
from workflows.records import SCHEMA_VERSION
from workflows.stages.plan import Chunk

if TYPE_CHECKING:
    import pandas as pd

GROUP = "solve-x"  # and the number of solve jobs that share a job of the cluster
GROUP_S = 1200.0  # maximum expected time of such a job
JOB_S = 10.0  # Snakemake and the stage start once for each solve job
JOB_MB = 1000  # of the processes around the worker
SPARE = 2.0  # requested time relative to the expected time
# A longer solve job is ended after this time, and tried again: it continues after its last finished run.
MOST_MINUTES = 30
SPARE_MEMORY = 1.25
WARM_UP, MEMORY = "time_warmup_s", "peak_memory_mb"
COLUMNS = ["method", "test", "outcome", "time_solve_s", "time_overhead_s", WARM_UP, MEMORY]


@dataclass(frozen=True)
class Measured:
    """Mean seconds per method and test, and maximum memory per method, of the runs in tables.

    Attributes
    ----------
    seconds : dict of (method, test) to seconds
        Those of the harness included.
    warm_up_s : dict of method to seconds
    memory_mb : dict of method to MiB
    """

    seconds: Mapping[tuple[str, str], float] = field(default_factory=dict)
    warm_up_s: Mapping[str, float] = field(default_factory=dict)
    memory_mb: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, experiment: Experiment, folder: Path) -> Measured:
        """Return what the runs of an experiment took, those of the quick part and of archives included.

        Parameters
        ----------
        experiment : Experiment
        folder : Path
            Results of the experiment.
        """
        seconds: dict[tuple[str, str], float] = {}
        warm_up_s: dict[str, float] = {}
        memory_mb: dict[str, float] = {}
        for runs in _tables(experiment, folder):
            spent = runs["time_solve_s"] + runs["time_overhead_s"].fillna(0.0)
            known = runs.assign(spent=spent).dropna(subset="spent")
            for cell, mean in known.groupby(["method", "test"])["spent"].mean().items():
                seconds.setdefault(cast(tuple[str, str], cell), mean)  # the first table counts
            by_method = known.groupby("method").agg({WARM_UP: "mean", MEMORY: "max"}).fillna(0.0)
            for method, mean, peak in by_method.itertuples(name=None):
                warm_up_s.setdefault(method, mean)
                memory_mb[method] = max(peak, memory_mb.get(method, 0.0))
        return cls(seconds, warm_up_s, memory_mb)

    def job(self, method: str, limits: LimitSettings, chunk: Chunk) -> JobNeeds:
        """Return what the solve job of a method and a chunk needs."""
        n_runs = len(chunk.instances)
        runs_s = sum(
            self.seconds.get((method, instance.test), limits.time_s) for instance in chunk.instances
        )
        peak = self.memory_mb.get(method) or math.inf
        return JobNeeds(
            JOB_S + self.warm_up_s.get(method, 0.0) + runs_s,
            JOB_S + limits.warm_up_s + n_runs * limits.kill_after_s,
            JOB_MB + min(limits.memory_mb, SPARE_MEMORY * peak),
            JOB_MB + limits.memory_mb,
        )


@dataclass(frozen=True)
class JobNeeds:
    """Expected and maximum seconds and MiB of a solve job."""

    expected_s: float
    limit_s: float
    expected_mb: float
    limit_mb: float

    def minutes(self, attempt: int) -> int:
        """Return the minutes to request; more for a job that is tried again."""
        needed_s = min(SPARE * attempt * self.expected_s, self.limit_s)
        return min(MOST_MINUTES, math.ceil(needed_s / 60.0))

    def memory_mb(self, attempt: int) -> int:
        """Return the MiB to request: the limit for a job that is tried again."""
        return math.ceil(self.expected_mb if attempt == 1 else self.limit_mb)

    def group(self, sizes: Mapping[str, int]) -> str | None:
        """Return the group with the most jobs that are expected to end within `GROUP_S`; None: no group.

        Parameters
        ----------
        sizes : dict
            ``group-components`` of the profile: jobs of each group; empty without a cluster.
        """
        fitting = [
            size
            for name, size in sizes.items()
            if name == f"{GROUP}{size}" and size * self.expected_s <= GROUP_S
        ]
        return f"{GROUP}{max(fitting)}" if fitting else None


def _tables(experiment: Experiment, folder: Path) -> Iterator[pd.DataFrame]:
    """Yield the runs of the experiment, of the latest archive, and of the quick part."""
    for place in (folder, folder / EVIDENCE):
        yield from _table(place)
    if (archived := runs_of(experiment.name)) is not None:
        yield archived
    limits = {each.name: experiment.limits_of(each).time_s for each in experiment.methods}
    for runs in _table(folder.with_name(f"{experiment.name}{QUICK}")):
        limited = runs["outcome"] == "limited"  # would take as long as the limit of the experiment
        yield runs.assign(
            time_solve_s=runs["time_solve_s"].mask(limited, runs["method"].map(limits))
        )


def _table(folder: Path) -> Iterator[pd.DataFrame]:
    import pandas as pd  # takes long to load, and only the main process on a cluster needs it

    path = folder / "tables" / "runs.parquet"
    if path.is_file() and not is_damaged(path):
        current = [("schema_version", "==", SCHEMA_VERSION)]
        yield pd.read_parquet(path, columns=COLUMNS, filters=current)
