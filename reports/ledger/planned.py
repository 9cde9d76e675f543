"""The comparisons of a check as planned, whether or not their runs exist yet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import pandas as pd

from reports.ledger.evidence import Role, methods_in
from reports.ledger.finding import CHECKS, SHARED, Parameters, on_axes, select

# Name, baseline, effective options and n_inliers ratio of a method.
Setting = tuple[str, str, Mapping[str, Any], float]


def first_block(datasets: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return a row per instance of the first trial of each test, from the datasets of a config.

    An entry without shapes, which stands for all shapes of the dataset, has one row per level.
    """
    rows = [
        (entry["dataset"], shape, test, float(level), 0, "")
        for entry in datasets
        for shape in entry.get("shapes") or [""]
        for test, levels in entry["tests"].items()
        for level in levels
    ]
    return pd.DataFrame(rows, columns=[*SHARED[:2], "test", "level", "trial", "method"])


def compared(check: Parameters, first: pd.DataFrame, axes: Mapping[str, float]) -> pd.DataFrame:
    """Return the instances of a block that a check compares."""
    return select(on_axes(first, check, axes), "", {**check, "where": {}})


def pairs(
    check: Parameters, roles: Mapping[str, Role], settings: Sequence[Setting]
) -> Iterator[list[list[str]]]:
    """Yield the methods of each comparison in a test, by role; none if no method has one of the roles."""
    always: list[str] = []
    for key in ("subject", "reference", "rival"):
        always += [check[key]] if isinstance(check.get(key), str) else check.get(key, [])
    for one, other in product(check.get("methods", [None]), check.get("rivals", [None])):
        names = [*always, *(role for role in (one, other) if role is not None)]
        filled = [methods_in(roles[name], settings) for name in names]
        if all(filled):
            yield filled


def columns_of(check: Parameters, table: pd.DataFrame) -> list[str]:
    """Return the columns whose values have a comparison each."""
    by = check.get("by", CHECKS[check["kind"]].by)
    return [column for column in by if column in table]


def instances(check: Parameters, block: pd.DataFrame) -> int:
    """Return how many instances of a block the comparison with the fewest has."""
    block = _units(check, block)
    by = columns_of(check, block)
    return int(block.groupby(by).size().min()) if by else len(block)


def count(
    check: Parameters,
    first: pd.DataFrame,
    axes: Mapping[str, float],
    roles: Mapping[str, Role],
    settings: Sequence[Setting],
) -> int:
    """Return the number of planned comparisons of a check."""
    block = _units(check, compared(check, first, axes))
    by = columns_of(check, block)
    places = block.groupby(by).ngroups if by else min(1, len(block))
    places *= len(check.get("quantities", [""]))
    return places * sum(_methods(filled) for filled in pairs(check, roles, settings))


def _units(check: Parameters, block: pd.DataFrame) -> pd.DataFrame:
    """Return a row per instance in the sense of the check: all levels of a trial may be one."""
    if not CHECKS[check["kind"]].per_trial:
        return block
    return block.drop_duplicates([*SHARED, "test"]).drop(columns="level")


def _methods(filled: Sequence[Sequence[str]]) -> int:
    """Return how many comparisons the methods of these roles have: each with each."""
    number = 1
    for names in filled:
        number *= len(names)
    return number
