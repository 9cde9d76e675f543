"""The datasets and tests of an experiment, and their checks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from dcreg.problem import suggestion
from workflows.parts import Part

Model = Literal["similarity2d", "rigid3d"]

MAX_RUNS = 1_000_000  # of an experiment; a plan holds all of them in memory
MAX_LEVEL = 10.0  # of disturbances: lengths in sides of the shape, or points per point


class DatasetSettings(Part):
    """One dataset and the grid of tests × levels × trials drawn from it."""

    dataset: str
    shapes: Annotated[list[str], Field(min_length=1)] | None = None  # all of the dataset's
    tests: Annotated[dict[str, list[float]], Field(min_length=1)]
    trials: Annotated[int, Field(gt=0)] = 1
    n_points: Annotated[int, Field(ge=3, le=100_000)] | None = None

    @field_validator("tests")
    @classmethod
    def _levels_differ(cls, tests: dict[str, list[float]]) -> dict[str, list[float]]:
        for test, levels in tests.items():
            if not levels or len(set(levels)) < len(levels):
                raise ValueError(f"{test}: give one or more different levels, not {levels}")
            if wrong := [level for level in levels if not math.isfinite(level)]:
                raise ValueError(f"{test}: level {wrong[0]} is not finite; give a number")
        return tests

    @field_validator("shapes")
    @classmethod
    def _shapes_differ(cls, shapes: list[str] | None) -> list[str] | None:
        if shapes and len(set(shapes)) < len(shapes):
            raise ValueError("a shape is listed twice; list each once")
        return shapes


def check_tier(asked: Sequence[DatasetSettings]) -> Iterable[str]:
    """Yield the tests of a tier whose clouds cannot be reduced to its number of points."""
    from data import registry
    from data.contract import RecordedDataset

    for entry in asked:
        dataset = registry.datasets().get(entry.dataset)
        fixed = isinstance(dataset, RecordedDataset) and [
            test for test in entry.tests if not dataset.takes_n_points(test)
        ]
        if fixed:
            yield (
                f"a tier of {entry.n_points} points is not possible: dataset {entry.dataset} has a fixed "
                f"number of points in {', '.join(fixed)}; run the experiment without POINTS and without "
                f"the ending -{entry.n_points}"
            )


def check_datasets(asked: Sequence[DatasetSettings]) -> Iterable[str]:
    """Yield unknown datasets, shapes, tests, levels and trials."""
    from data import registry
    from data.contract import Axis, DataError, RecordedDataset
    from workflows.disturb import DISTURBANCES

    known = registry.datasets()
    for index, entry in enumerate(asked):
        key = f"datasets[{index}]"
        if entry.dataset not in known:
            yield f"{key}.dataset: no dataset {entry.dataset!r}{suggestion(entry.dataset, known)}"
            continue
        try:
            dataset = known[entry.dataset]
        except DataError as error:
            yield f"{key}.dataset: {error}"
            continue
        for shape in entry.shapes or ():
            if shape not in dataset.shapes():
                yield f"{key}.shapes: no shape {shape!r}{suggestion(shape, dataset.shapes())}"
        recorded: dict[str, Axis] = {}
        if isinstance(dataset, RecordedDataset):
            recorded = dataset.tests()
            fixed = [test for test in entry.tests if not dataset.takes_n_points(test)]
            if fixed and entry.n_points is not None:
                yield f"{key}.n_points: {entry.dataset} has a fixed number of points; remove it"
        tests = recorded or DISTURBANCES
        for test, levels in entry.tests.items():
            if test not in tests:
                yield f"{key}.tests.{test}: no such test{suggestion(test, tests)}"
            elif recorded:
                axis = recorded[test]
                for level in sorted(set(levels) - set(axis.levels)):
                    yield f"{key}.tests.{test}: no level {level:g}; it has {list(axis.levels)}"
                if entry.trials > axis.n_trials:
                    yield (
                        f"{key}.trials: {test} has {axis.n_trials} trials, not {entry.trials}; "
                        "lower it"
                    )
            else:
                for level in levels:
                    yield from _check_level(f"{key}.tests.{test}", test, level, entry.n_points)


def _check_level(key: str, test: str, level: float, n_points: int | None) -> Iterable[str]:
    """Yield levels that the disturbance refuses for this number of points."""
    from workflows.disturb import DISTURBANCES

    if not 0 <= level <= MAX_LEVEL:
        yield f"{key}: level {level:g}; give one from 0 to {MAX_LEVEL:g}"
        return
    rng = np.random.default_rng(0)
    try:
        DISTURBANCES[test](rng.random((min(n_points or 100, 100), 2)), level, rng)
    except ValueError as error:
        yield f"{key}: {error}"


def check_size(
    asked: Sequence[DatasetSettings], models: Sequence[list[Model] | None]
) -> Iterable[str]:
    """Yield an experiment that is too large, and methods without an instance."""
    from data import registry

    known = registry.datasets()
    counts: dict[str, int] = {}
    for entry in asked:
        for shape in entry.shapes or known[entry.dataset].shapes():
            model = known[entry.dataset].model(shape)
            n_levels = sum(map(len, entry.tests.values()))
            counts[model] = counts.get(model, 0) + n_levels * entry.trials
    if (runs := sum(counts.values()) * len(models)) > MAX_RUNS:
        yield f"datasets: {runs:,} runs, at most {MAX_RUNS:,}; lower trials, or split the experiment"
    for index, treated in enumerate(models):
        if treated and not set(treated) & set(counts):
            yield (
                f"methods[{index}].models: no dataset has {' or '.join(treated)}, only "
                f"{' and '.join(counts)}; correct models, or leave the method out"
            )
