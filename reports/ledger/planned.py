"""The comparisons of a claim as planned, whether or not their runs exist yet.

In tables of blocks, the tests and levels with runs are those that some claim has needed so far. So what a
claim compares is read from the config of the experiment, not from the runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from reports.ledger.evidence import SHARED, TRIAL
from reports.ledger.finding import (
    CHECKS,
    Cells,
    Parameters,
    Part,
    cells_of,
    on_axes,
    select,
)

Fill = Callable[[str], list[str]]  # name of a role -> its methods


@dataclass(frozen=True)
class Planned:
    """A comparison: its methods, and the tests and levels that its figure is about.

    ``number`` figures have these methods and cells, one per quantity.
    """

    methods: tuple[str, ...]
    cells: Cells
    number: int

    def has(self, part: Part) -> bool:
        """Tell whether a figure is one of this comparison; it may lack runs without its quantity."""
        is_here = bool(part.cells) and part.cells <= self.cells
        return is_here and set(part.methods) <= set(self.methods)


def first_block(datasets: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return a row per instance of the first trial of each test, from datasets with a list of shapes."""
    rows = [
        (entry["dataset"], shape, test, float(level), 0, "")
        for entry in datasets
        for shape in entry["shapes"]
        for test, levels in entry["tests"].items()
        for level in levels
    ]
    return pd.DataFrame(rows, columns=[*SHARED[:2], "test", "level", "trial", "method"])


def compared(check: Parameters, first: pd.DataFrame, axes: Mapping[str, float]) -> pd.DataFrame:
    """Return the instances of a block that a check compares."""
    return select(on_axes(first, check, axes), "", {**check, "where": {}})


def places(check: Parameters, block: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the instances of each figure of a check."""
    if block.empty:
        return []
    by = [column for column in _by(check) if column in block]
    return [part for _, part in block.groupby(by, sort=False)] if by else [block]


def is_by_test(check: Parameters) -> bool:
    """Tell whether each test has figures of its own."""
    return "test" in _by(check)


def trials_in(place: pd.DataFrame) -> int:
    """Return how many trials a figure has per block."""
    return len(place.drop_duplicates(TRIAL))


def roles(check: Parameters) -> Iterator[list[str]]:
    """Yield the roles of each comparison in a test: each method with each rival."""
    always: list[str] = []
    for key in ("subject", "reference", "rival"):
        always += [check[key]] if isinstance(check.get(key), str) else check.get(key, [])
    for one, other in product(check.get("methods", [None]), check.get("rivals", [None])):
        yield [*always, *(role for role in (one, other) if role is not None)]


def comparisons(
    check: Parameters, block: pd.DataFrame, filled: Sequence[Sequence[str]]
) -> list[Planned]:
    """Return the comparisons of the methods of some roles on the instances of a block."""
    number = len(check.get("quantities", [""]))
    return [
        Planned(tuple(names), cells_of(place), number)
        for place in places(check, block)
        for names in product(*filled)
    ]


@dataclass(frozen=True)
class Design:
    """What the claims compare in an experiment of blocks.

    Attributes
    ----------
    first : DataFrame
        The instances of the first block of each test.
    axes : mapping
        Test -> last level that the paper shows.
    fill : callable
        Name of a role -> its methods.
    """

    first: pd.DataFrame
    axes: Mapping[str, float]
    fill: Fill

    def select(self, runs: pd.DataFrame, method: str, check: Parameters) -> pd.DataFrame:
        """Return the runs of a method that a check compares, those of incomplete trials left out."""
        block = compared(check, self.first, self.axes)
        own = select(runs, method, {**check, "levels": None})
        own = own[_is_in(block, own)]
        return own if check.get("statistic") == "maximum" else complete(check, block, own)

    def figures(self, check: Parameters) -> list[Planned]:
        """Return the comparisons of a check."""
        block = compared(check, self.first, self.axes)
        return [
            each
            for names in roles(check)
            for each in comparisons(check, block, [self.fill(name) for name in names])
        ]


def missing(figures: Sequence[Planned], parts: Sequence[Part]) -> int:
    """Return how many planned comparisons have no value."""
    return sum(max(0, each.number - sum(map(each.has, parts))) for each in figures)


def complete(check: Parameters, block: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of trials that have all levels and tests of a figure.

    Otherwise, the weight of a level would depend on how often other claims needed it.
    """
    kept = pd.Series(True, runs.index)
    for place in places(check, block):
        if len(cells_of(place)) == 1:
            continue
        here = runs[_is_in(place, runs)]
        needed = place.groupby(SHARED[:2]).size()
        number = here.groupby(["method", *SHARED])["level"].transform("size")
        shapes = pd.MultiIndex.from_frame(here[SHARED[:2]])
        kept[here.index[number.to_numpy() < needed.reindex(shapes).fillna(0).to_numpy()]] = False
    return runs[kept]


def _is_in(place: pd.DataFrame, runs: pd.DataFrame) -> np.ndarray:
    """Return for each run whether its test and level are those of a figure."""
    found = np.zeros(len(runs), dtype=bool)
    for test, levels in place.groupby("test")["level"]:
        found |= (runs["test"].eq(test) & runs["level"].isin(levels.unique())).to_numpy()
    return found


def _by(check: Parameters) -> Sequence[str]:
    return check.get("by", CHECKS[check["kind"]].by)
