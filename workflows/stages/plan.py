"""Expand an experiment into its instances, chunks of instances, and planned runs.

The plan depends on the config and the selection only, so it is the same on every machine. A chunk is a
list of instances of one model that share a file and a solve job. Its name contains a hash of its content,
so a partial selection never overwrites the results of the whole.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from baselines import registry as methods
from data import registry
from dcreg.problem import suggestion
from workflows import records
from workflows.blocks import EVIDENCE, Needs
from workflows.config import (
    ConfigError,
    DatasetSettings,
    Experiment,
    MethodSettings,
    Selection,
    with_methods,
)
from workflows.hashing import digest

if TYPE_CHECKING:
    import pandas as pd

MAX_NAME = 100  # letters of a folder's name
MOST_IN_BLOCK = 4  # instances of a chunk of a block
SHORT = {"similarity2d": "2d", "rigid3d": "3d"}


@dataclass(frozen=True)
class InstanceSpec:
    """One registration problem, by the axes that determine it."""

    dataset: str
    shape: str
    test: str
    level: float
    trial: int
    n_points: int | None
    model: str

    @cached_property
    def instance_id(self) -> str:
        return digest(asdict(self))


@dataclass(frozen=True)
class Chunk:
    """Instances of one model, generated into one file and solved in one job per method."""

    name: str
    model: str
    instances: tuple[InstanceSpec, ...]

    @property
    def block(self) -> tuple[str, float, int]:
        """Test, a level and trial of a chunk of a block; all its levels are run by the same methods."""
        return self.instances[0].test, self.instances[0].level, self.instances[0].trial

    @property
    def datasets(self) -> list[str]:
        return sorted({instance.dataset for instance in self.instances})


@dataclass(frozen=True)
class PlannedRun:
    """One execution: an instance under a method with its options and limits."""

    run_id: str
    chunk: Chunk
    method: MethodSettings
    instance: InstanceSpec


@dataclass(frozen=True)
class Plan:
    """The planned runs. ``config`` is the name or path of the experiment's config."""

    config: str
    experiment: Experiment
    selection: Selection
    chunks: tuple[Chunk, ...]
    methods: tuple[MethodSettings, ...]
    needs: Needs | None = None  # every chunk then belongs to a block

    def jobs(self) -> Iterator[tuple[MethodSettings, Chunk]]:
        """Yield the methods with the chunks that they are run on."""
        for method, chunk in self.pairs():
            if self.is_needed(method, chunk):
                yield method, chunk

    def is_needed(self, method: MethodSettings, chunk: Chunk) -> bool:
        return self.needs is None or self.needs.uses(method.name, *chunk.block)

    def pairs(self) -> Iterator[tuple[MethodSettings, Chunk]]:
        """Yield all planned methods and chunks, including those that are not needed."""
        for method, chunk in product(self.methods, self.chunks):
            if not method.models or chunk.model in method.models:
                yield method, chunk

    def runs(self) -> Iterator[PlannedRun]:
        """Yield all needed runs; takes seconds for an experiment of the paper, as each is hashed."""
        for method, chunk in self.jobs():
            yield from self._runs_of(method, chunk)

    def left_out(self) -> Iterator[PlannedRun]:
        """Yield the planned runs that are not needed."""
        for method, chunk in self.pairs():
            if not self.is_needed(method, chunk):
                yield from self._runs_of(method, chunk)

    def _runs_of(self, method: MethodSettings, chunk: Chunk) -> Iterator[PlannedRun]:
        identity = method_identity(self.experiment, method)
        for instance in chunk.instances:
            run_id = run_identity(identity, instance.instance_id)
            yield PlannedRun(run_id, chunk, method, instance)

    @property
    def view(self) -> Path:
        """Folder of plan, metrics, tables and report, below the results of the experiment.

        A part has a separate folder and never replaces tables of the whole. Instances and runs are
        shared.
        """
        if self.needs is not None:
            return Path(EVIDENCE)
        chosen = {axis: values for axis, values in self.selection if values}
        if not chosen:
            return Path()
        words = [f"{axis}-{'+'.join(sorted(map(str, values)))}" for axis, values in chosen.items()]
        name = re.sub(r"[^A-Za-z0-9._+-]", "-", "_".join(words))
        return Path("parts", name if len(name) <= MAX_NAME else f"{name[:60]}-{digest(name)}")

    def chunk(self, name: str) -> Chunk:
        return next(chunk for chunk in self.chunks if chunk.name == name)


def run_identity(identity: dict[str, Any], instance_id: str) -> str:
    """Return the ``run_id``: a hash of everything in the config that can change the result.

    `identity` is that of the method.
    """
    return digest([instance_id, identity])


def method_identity(experiment: Experiment, method: MethodSettings) -> dict[str, Any]:
    """Return the settings of a method that can change its results."""
    return {
        "method": method.name,
        "baseline": method.baseline,
        "options": method.options,
        "n_inliers_ratio": method.n_inliers_ratio,
        **({} if method.n_points is None else {"n_points": method.n_points}),
        "seed": experiment.seed,
        "limits": experiment.limits_of(method).model_dump(),
    }


def expand(
    experiment: Experiment,
    selection: Selection | None = None,
    config: str = "",
    needs: Needs | None = None,
) -> Plan:
    """Return the plan of the selected part of an experiment, or of the needed blocks.

    A selected method that the experiment does not have is added to it, if it exists.

    Raises
    ------
    ConfigError
        If the selection names something that the experiment does not have, or selects no run.
    """
    selection = selection or Selection()
    of_blocks = {name for own in needs.trials.values() for name in own} if needs else set()
    experiment = with_methods(experiment, [*selection.methods, *sorted(of_blocks)])
    instances = _instances(experiment)
    _check_selection(experiment, selection, instances)
    chosen = [instance for instance in instances if _selected(instance, selection)]
    chosen_methods = tuple(
        method
        for method in experiment.methods
        if not selection.methods or method.name in selection.methods
    )
    split = _chunks(chosen, experiment.chunk_size) if needs is None else blocks(chosen, needs)
    plan = Plan(
        config or experiment.name, experiment, selection, tuple(split), chosen_methods, needs
    )
    if needs is None and next(plan.jobs(), None) is None:
        raise ConfigError(
            f"experiment {experiment.name}: the selection contains no run; "
            "select a method and tests of the same model"
        )
    return plan


def plan_table(plan: Plan, runs: Iterable[PlannedRun] | None = None) -> pd.DataFrame:
    """Return a table with one row per run: all needed ones, or those given."""
    effective = {
        method.name: json.dumps(
            methods.effective_options(method.baseline, method.options), sort_keys=True
        )
        for method in plan.methods
    }
    rows = [
        {
            "run_id": run.run_id,
            "chunk_id": run.chunk.name,
            "method": run.method.name,
            "baseline": run.method.baseline,
            "options": json.dumps(run.method.options, sort_keys=True),
            "options_effective": effective[run.method.name],
            "instance_id": run.instance.instance_id,
            **{axis: getattr(run.instance, axis) for axis in ("dataset", "shape", "test")},
            **{axis: getattr(run.instance, axis) for axis in ("level", "trial", "model")},
        }
        for run in (plan.runs() if runs is None else runs)
    ]
    assert len({row["run_id"] for row in rows}) == len(rows)
    return records.frame(rows, records.PLAN)


def size_notes(plan: Plan) -> list[str]:
    """Return a note for each dataset of the plan whose clouds are reduced."""
    sizes = {
        (spec.dataset, spec.n_points): None for chunk in plan.chunks for spec in chunk.instances
    }
    notes = [registry.dataset(name).size_note(n_points) for name, n_points in sizes]
    return list(filter(None, dict.fromkeys(notes)))


def _instances(experiment: Experiment) -> list[InstanceSpec]:
    known = registry.datasets()
    specs = [
        InstanceSpec(entry.dataset, *axes, entry.n_points, known[entry.dataset].model(axes[0]))
        for entry in experiment.datasets
        for axes in _grid(entry, known[entry.dataset].shapes())
        if known[entry.dataset].has(*axes)
    ]
    twice = (
        [spec for spec in specs if specs.count(spec) > 1] if len(set(specs)) < len(specs) else []
    )
    if twice:
        first = twice[0]
        raise ConfigError(
            f"experiment {experiment.name}: {first.dataset} {first.shape} {first.test} "
            f"{first.level:g} is planned twice; merge the two entries of datasets"
        )
    return specs


def _grid(entry: DatasetSettings, shapes: list[str]) -> Iterator[tuple[str, str, float, int]]:
    for shape, (test, levels) in product(entry.shapes or shapes, entry.tests.items()):
        for level, trial in product(levels, range(entry.trials)):
            yield shape, test, level, trial


def _chunks(instances: Sequence[InstanceSpec], size: int) -> Iterator[Chunk]:
    for model in sorted({instance.model for instance in instances}):
        alike = [instance for instance in instances if instance.model == model]
        for index, members in enumerate(_mixed(alike, size)):
            content = digest([member.instance_id for member in members], 6)
            yield Chunk(f"{SHORT[model]}-{index:02d}-{content}", model, members)


def _mixed(instances: Sequence[InstanceSpec], size: int) -> Iterator[tuple[InstanceSpec, ...]]:
    """Yield parts of at most `size` instances with similar shares of easy and hard levels."""
    number = -(-len(instances) // size)
    for index in range(number):
        yield tuple(instances[index::number])


def blocks(instances: Sequence[InstanceSpec], needs: Needs) -> Iterator[Chunk]:
    """Yield the chunks of each needed trial: of one model, and run by the same methods.

    They are small, so that the runs of one slow method use several cores.
    """
    found: dict[tuple[str, str, int, tuple[str, ...]], list[InstanceSpec]] = {}
    for each in instances:
        if users := needs.users(each.test, each.level, each.trial):
            found.setdefault((each.model, each.test, each.trial, users), []).append(each)
    for (model, _, trial, _), members in found.items():
        for part in _mixed(members, MOST_IN_BLOCK):
            content = digest([member.instance_id for member in part], 6)
            yield Chunk(f"{SHORT[model]}-{trial:02d}-{content}", model, part)


def _selected(instance: InstanceSpec, selection: Selection) -> bool:
    chosen: list[tuple[Any, Sequence[Any]]] = [
        (instance.dataset, selection.datasets),
        (instance.shape, selection.shapes),
        (instance.test, selection.tests),
        (instance.level, selection.levels),
        (instance.trial, selection.trials),
    ]
    return all(not wanted or value in wanted for value, wanted in chosen)


def _check_selection(
    experiment: Experiment, selection: Selection, instances: Iterable[InstanceSpec]
) -> None:
    instances = list(instances)
    have: dict[str, set[Any]] = {
        "methods": {method.name for method in experiment.methods},
        "datasets": {instance.dataset for instance in instances},
        "shapes": {instance.shape for instance in instances},
        "tests": {instance.test for instance in instances},
        "levels": {instance.level for instance in instances},
        "trials": {instance.trial for instance in instances},
    }
    for axis, known in have.items():
        for value in getattr(selection, axis):
            if value not in known:
                words = [f"{word:g}" if isinstance(word, float) else str(word) for word in known]
                words += methods.names() if axis == "methods" else []
                raise ConfigError(
                    f"experiment {experiment.name}: selection {axis.upper()}={value} matches "
                    f"nothing{suggestion(str(value), dict.fromkeys(words))}"
                )
