"""Which methods are best on each test: success rates, each compared with the highest one."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from reports.tables import Tables, is_right, share_interval
from workflows.outcomes import attempted
from workflows.significance import SIGNIFICANT, exact_p, holm

ALL = "all tests"
BEST, TIED, FEW, WORSE = "best", "tied", "few", "worse"


@dataclass(frozen=True)
class Cell:
    """The right runs of one method on one test.

    `standing` is `BEST` for the highest success rate of the methods that attempted the most instances,
    `TIED` for others that are not significantly worse, `FEW` if there are too few instances for any
    difference to be significant, `WORSE` for all others. It is empty for methods that receive the true
    pairs or attempted fewer than half of the instances, and where no two methods are compared, as if each
    ran only on the trials that claims needed.
    """

    right: int
    runs: int
    standing: str

    @property
    def share(self) -> float:
        return self.right / self.runs

    @property
    def interval(self) -> tuple[float, float]:
        return share_interval(self.right, self.runs)


@dataclass(frozen=True)
class Matrix:
    """Success of all methods on all tests of a model.

    The first column holds all tests together, unless each method ran on other instances.
    """

    model: str
    columns: list[str]
    rows: dict[str, dict[str, Cell]]  # by method: the highest first, those not compared last

    @property
    def is_compared(self) -> bool:
        """Whether any column compares methods."""
        return any(cell.standing for row in self.rows.values() for cell in row.values())

    def standing(self, standing: str) -> list[str]:
        """Return the methods with a standing in the first column."""
        first = self.columns[0]
        return [name for name, row in self.rows.items() if row[first].standing == standing]


def matrices(tables: Tables) -> list[Matrix]:
    """Return a matrix for each model with attempted runs."""
    columns = ["model", "test", "method", "outcome", "success", "instance_id", "instance_digest"]
    runs = attempted(tables.runs[columns])
    runs = runs.assign(success=is_right(runs))
    return [_matrix(tables, str(model), part) for model, part in runs.groupby("model", sort=False)]


def _matrix(tables: Tables, model: str, runs: pd.DataFrame) -> Matrix:
    tests = list(runs["test"].unique())
    # two lists of scans can have the same pair
    once = runs[~runs.duplicated(["method", "instance_digest"])]
    parts = {ALL: once} if len(tests) > 1 else {}
    parts |= {test: runs[runs["test"] == test] for test in tests}
    columns = {name: _column(tables, part) for name, part in parts.items()}
    first = next(iter(columns.values()))

    def rank(method: str) -> tuple[bool, float, int]:
        return not first[method].standing, -first[method].share, tables.methods.index(method)

    rows = {
        method: {name: cells[method] for name, cells in columns.items() if method in cells}
        for method in sorted(first, key=rank)
    }
    # methods that ran on different instances cannot be compared over all tests
    shown = [name for name in columns if not (name == ALL and tables.is_of_blocks)]
    return Matrix(model, shown, rows)


def _column(tables: Tables, runs: pd.DataFrame) -> dict[str, Cell]:
    """Return the cell of each method.

    The same runs decide which method has the highest rate, so any two methods might have been compared.
    The correction is therefore for all pairs of k methods: k / 2 times that for k - 1 comparisons.
    """
    right = runs.pivot_table(
        index="instance_id", columns="method", values="success", aggfunc="first"
    )
    counts = right.count()
    rivals = [
        name
        for name in tables.methods
        if name in right and not tables.is_oracle(name) and 2 * counts[name] >= len(right)
    ]
    standing = dict.fromkeys(right, "")
    # if runs were added until claims were decided, a test for a fixed number of runs is not valid
    if len(rivals) > 1 and not tables.is_of_blocks:
        most = counts[rivals].max()
        shares = {name: right[name].mean() for name in rivals if counts[name] == most}
        best = max(shares, key=lambda name: shares[name])
        others = [name for name in rivals if shares.get(name) != shares[best]]
        pairs = len(rivals) / 2
        p_of = [_p_value(right[best], right[name]) * pairs for name in others]
        standing |= dict.fromkeys(rivals, BEST)
        for name, p, level in zip(others, p_of, holm(p_of), strict=True):
            common = (right[best].notna() & right[name].notna()).sum()
            # the level of the smallest p-value is the strictest: beyond it the other pairs decide
            could_differ = exact_p(0, common) * pairs <= SIGNIFICANT / len(others)
            standing[name] = WORSE if p <= level else TIED if could_differ else FEW
    return {
        str(name): Cell(int(column.sum()), int(column.count()), standing[name])
        for name, column in right.items()
    }


def _p_value(best: pd.Series, other: pd.Series) -> float:
    """Return the p-value of McNemar's exact test on the instances that both attempted.

    It is 1 if the other method, which may have attempted fewer instances, is not behind on them.
    """
    both = best.notna() & other.notna()
    best, other = best[both].astype(bool), other[both].astype(bool)
    wins, losses = (best & ~other).sum(), (~best & other).sum()
    return float(exact_p(wins, losses)) if wins > losses else 1.0
