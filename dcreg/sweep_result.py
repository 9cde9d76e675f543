"""The result of a sweep: a result for each number of pairs, their table, and a suggestion."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg.diagnostics import TOO_FEW_PAIRS, TOO_MANY_PAIRS
from dcreg.files import Document, plain, whole_file
from dcreg.result import Result
from dcreg.status import Status

_NUMBER = re.compile(r"\d+(\.\d+)?(e[+-]?\d+)?")
# The RMS residual is divided by this power of the number of pairs. The minimum is where the residuals of
# further pairs begin to exceed sqrt(1 + 2 * 3) = 2.6 times the RMS of the earlier ones.
_FRACTION_POWER = 3
# A residual below this fraction of the tolerance counts as rounding.
_ROUNDING = 1e-3
_NO_VALUE = "-"  # in the table


@dataclass(frozen=True, repr=False)
class SweepResult(Document):
    """Optima for several `n_inliers` in ascending order. ``print(found)`` shows their table.

    Attributes
    ----------
    results : list of Result
        One for each number of pairs, as from `dcreg.register`, with the work and time spent on it. If
        another search proved the bounds, `n_nodes` is 0.
    proven_by : list of int or None
        The number of pairs of the search that proved the `lower_bound` of each result; None if no search
        was needed because 0 is a lower bound.
    residuals : list of float, optional
        With weights, the RMS residuals of the returned pairs, which `rmse_matched` of the results
        replaces by weighted costs; None without weights.
    """

    results: list[Result]
    proven_by: list[int | None]
    residuals: list[float] | None = None

    @property
    def status(self) -> Status:
        """``optimal`` if all results are, otherwise the status of the first one that is not."""
        return next((r.status for r in self.results if not r.success), Status.OPTIMAL)

    @property
    def suggested_n_inliers(self) -> int | None:
        """The number of pairs with the minimum fractional RMSE of the final pose: not proven.

        The fractional RMSE is the RMSE divided by the cube of the number of pairs (after Phillips, Liu
        and Tomasi 2007), without weights and attributes. Results with a warning about too many or too few
        pairs are excluded. None if the minimum is at an end of the sweep, or if the time limit made the
        choice of pairs greedy.
        """
        if any(result.is_greedy for result in self.results):
            return None
        k = np.array([r.n_inliers for r in self.results], dtype=float)
        rmse = np.array(self.residuals or [r.rmse_matched for r in self.results])
        last = self.results[-1]
        floor = _ROUNDING * np.sqrt(last.gap_tol / last.n_bounded)
        fraction = np.maximum(rmse, floor) / k**_FRACTION_POWER
        wrong = [
            any(TOO_MANY_PAIRS in line or TOO_FEW_PAIRS in line for line in r.warnings)
            for r in self.results
        ]
        at = int(np.argmin(np.where(wrong, np.inf, fraction)))
        return int(k[at]) if 0 < at < len(k) - 1 else None

    @property
    def warnings(self) -> list[str]:
        """The warnings of all `results`; lines that differ only in numbers are given once."""
        counts = [result.n_inliers for result in self.results]
        found: dict[str, dict[int, str]] = {}  # n_inliers and line, by the line without numbers
        for result in self.results:
            for line in result.warnings:
                found.setdefault(_NUMBER.sub("#", line), {})[result.n_inliers] = line
        return [_one_of(lines, counts) for lines in found.values()]

    def rows(self) -> list[dict[str, Any]]:
        """Return one row of plain numbers for each number of pairs, for tables and figures.

        ``rms_lower`` and ``rms`` enclose the RMS residual at the optimum: they are the square roots of
        the bounds per pair. With weights or attributes, the bounds are those of costs. ``marginal_cost``
        is the mean increase of the upper bound per additional pair up to the next row;
        ``marginal_cost_lower`` and ``marginal_cost_upper`` enclose that of the optimum. ``rmse_matched``
        refers to the final pose; in 3D mode ``paper`` the others refer to norms.
        """
        following: list[Result | None] = [*self.results[1:], None]
        return list(starmap(_row, zip(self.results, following, self.proven_by, strict=True)))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: the table, the suggestion, and every result."""
        return {
            "status": self.status.value,
            "suggested_n_inliers": self.suggested_n_inliers,
            "warnings": self.warnings,
            "table": self.rows(),
            "results": [result.to_dict() for result in self.results],
        }

    def write_csv(self, path: str | Path) -> None:
        """Write `rows`, each with its final pose (T00, T01, ...); a missing value is an empty field."""
        rows = [
            plain(row) | {f"T{i}{j}": x for (i, j), x in np.ndenumerate(result.T_target_source)}
            for row, result in zip(self.rows(), self.results, strict=True)
        ]
        with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, rows[0])
            writer.writeheader()
            writer.writerows(rows)

    def summary(self) -> str:
        """Return the table, the suggestion and the warnings as lines of plain text."""
        warnings = [f"warning: {line}" for line in self.warnings]
        return "\n".join([text.table(*self.table(), left=["status"]), *self.notes(), *warnings])

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return the headings and the `rows` as text."""
        flat = self.results[0].model == "similarity2d"
        headings = [
            "pairs", "status", "lower bound", "upper bound", "proven", "RMS", "marginal cost",
            "proven by", *([] if flat else ["RMSE of pose"]), "nodes", "time",
        ]  # fmt: skip
        suggested = self.suggested_n_inliers
        rows = [
            [
                f"{'* ' if row['n_inliers'] == suggested else ''}{row['n_inliers']}",
                row["status"],
                f"{row['lower_bound']:.5g}",
                f"{row['upper_bound']:.5g}",
                "exact fit" if result.is_exact else text.percent(row["bound_ratio"]),
                f"{row['rms_lower']:.4g} to {row['rms']:.4g}",
                _NO_VALUE if row["marginal_cost"] is None else f"{row['marginal_cost']:.4g}",
                _NO_VALUE if row["proven_by"] is None else f"k={row['proven_by']}",
                *([] if flat else [f"{row['rmse_matched']:.4g}"]),
                str(row["n_nodes"]),
                f"{row['time_s']:.2f} s",
            ]
            for row, result in zip(self.rows(), self.results, strict=True)
        ]
        return headings, rows

    def notes(self) -> list[str]:
        """Return the meaning of the columns, and the suggestion."""
        suggested = self.suggested_n_inliers
        legend = (
            f"bounds on: {self.results[0].certificate_scope}; proven: lower bound in % of the upper "
            "bound; RMS: sqrt(bound / pairs), units of the target; "
            "marginal cost: increase of the upper bound per additional pair"
        )
        if any(result.is_greedy for result in self.results):
            hint = "suggestion: none; pairs were chosen greedily because the time limit was hit"
        elif suggested is None:
            hint = (
                "suggestion: none; the smallest or the largest of these numbers of pairs fits best, so a "
                "number beyond them may fit better"
            )
        else:
            hint = (
                f"suggestion (*), not proven: {suggested} pairs; beyond this number the residuals of "
                "these poses increase sharply"
            )
        return [legend, *self._sample(), hint]

    def _sample(self) -> list[str]:
        """Return what was searched if it is not the full clouds."""
        if (searched := self.results[0].downsampled) is None:
            return []
        counts = ", ".join(f"{r.n_inliers} as {r.n_bounded}" for r in self.results)
        return [
            f"downsampled to {searched.n_source} source and {searched.n_target} target points: the "
            f"bounds refer to pairs of these ({counts}); the poses are refined on all points"
        ]

    __str__ = summary

    def __repr__(self) -> str:
        counts = [result.n_inliers for result in self.results]
        return (
            f"<SweepResult {self.status.value}: {len(counts)} values of n_inliers from {counts[0]} to "
            f"{counts[-1]}>"
        )


def _one_of(lines: dict[int, str], counts: list[int]) -> str:
    """Return one line per warning, with the values of `n_inliers` that have it."""
    (first, line), *others = lines.items()
    if len(lines) == len(counts) and len(set(lines.values())) == 1:
        return line
    if not others:
        return f"k={first}: {line}"
    alike = "all others" if len(lines) == len(counts) else ", ".join(f"k={k}" for k, _ in others)
    return f"k={first}: {line} (likewise {alike})"


def _row(result: Result, after: Result | None, proven_by: int | None) -> dict[str, Any]:
    k = result.n_bounded
    names = ("n_inliers", "status", "lower_bound", "upper_bound", "gap", "gap_tol", "bound_ratio")
    row: dict[str, Any] = {name: getattr(result, name) for name in names} | {
        "status": result.status.value,
        "rms": float(np.sqrt(result.upper_bound / k)),
        "rms_lower": float(np.sqrt(max(0.0, result.lower_bound) / k)),
        "rmse_matched": result.rmse_matched,
        "marginal_cost": None,
        "marginal_cost_lower": None,
        "marginal_cost_upper": None,
        "proven_by": proven_by,
        "n_nodes": result.n_nodes,
        "n_assignments": result.n_assignments,
        "time_s": result.time_solve_s,
    }
    if after is not None and (more := after.n_bounded - k) > 0:
        row["marginal_cost"] = (after.upper_bound - result.upper_bound) / more
        # if further pairs cost less than an average pair of the optimum for k, the k cheapest of k' pairs
        # would be better than this optimum
        floor = result.lower_bound / k
        row["marginal_cost_lower"] = max((after.lower_bound - result.upper_bound) / more, floor)
        row["marginal_cost_upper"] = (after.upper_bound - result.lower_bound) / more
    return row
