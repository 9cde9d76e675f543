"""What a sweep over cardinalities returns: one result each, a table of them, a suggestion."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.diagnostics import TOO_MANY_PAIRS
from dcreg.files import as_json, plain, whole_file, write_text
from dcreg.result import Result
from dcreg.status import Status

_NUMBER = re.compile(r"\d+(\.\d+)?(e[+-]?\d+)?")
# The RMS residual is weighed by this power of the number of pairs: least where residuals of further pairs
# begin to exceed sqrt(1 + 2 * 3) = 2.6 times the RMS of those before.
_FRACTION_POWER = 3
# A residual below this share of the tolerated one is rounding.
_ROUNDING = 1e-3


@dataclass(frozen=True, repr=False)
class SweepResult:
    """Optima for several cardinalities, fewest pairs first. ``print(found)`` shows their table.

    Attributes
    ----------
    results : list of Result
        One per cardinality, as of `dcreg.register` in mode ``paper``. Work and time are those spent
        on this cardinality; where another search proved the bounds there are no nodes.
    proven_by : list of int or None
        The cardinality whose search gave the `lower_bound` of each result, perhaps its own; None
        where no search was needed because the objective is a sum of squares.
    """

    results: list[Result]
    proven_by: list[int | None]

    @property
    def status(self) -> Status:
        """``optimal`` if all are; else that of the first one that is not."""
        return next((r.status for r in self.results if not r.success), Status.OPTIMAL)

    @property
    def suggested_n_inliers(self) -> int | None:
        """Where the fractional RMSE of the final poses is least: a suggestion, nothing is proven of it.

        That is the RMSE over the cube of the number of pairs (after Phillips, Liu and Tomasi 2007), of
        those that no warning calls too many pairs. None where it is least at an end, so that the answer
        may lie beyond, and where the time was over before all pairs were matched.
        """
        if any(result.is_greedy for result in self.results):
            return None
        k = np.array([r.n_inliers for r in self.results], dtype=float)
        rmse = np.array([r.rmse_matched for r in self.results])
        last = self.results[-1]
        least = _ROUNDING * np.sqrt(last.gap_tol / last.n_bounded)
        fraction = np.maximum(rmse, least) / k**_FRACTION_POWER
        loose = [any(TOO_MANY_PAIRS in line for line in r.warnings) for r in self.results]
        at = int(np.argmin(np.where(loose, np.inf, fraction)))
        return int(k[at]) if 0 < at < len(k) - 1 else None

    @property
    def warnings(self) -> list[str]:
        """Those of all `results`; lines that differ in numbers at most are said once."""
        counts = [result.n_inliers for result in self.results]
        found: dict[str, dict[int, str]] = {}  # cardinality and line, by the line without numbers
        for result in self.results:
            for line in result.warnings:
                found.setdefault(_NUMBER.sub("#", line), {})[result.n_inliers] = line
        return [_one_of(lines, counts) for lines in found.values()]

    def rows(self) -> list[dict[str, Any]]:
        """One row of plain numbers per cardinality, for tables and figures.

        ``rms_low`` and ``rms`` enclose the RMS residual at the optimum: the roots of the bounds
        per pair. ``next_pair`` is the mean increase of the objective per additional pair up to
        the next cardinality of the sweep, by the upper bounds; ``next_pair_low`` and
        ``next_pair_high`` enclose that of the optima. ``rmse_matched`` is of the final pose; in 3D
        the others speak of norms.
        """
        following: list[Result | None] = [*self.results[1:], None]
        return [
            _row(result, after, proven_by)
            for result, after, proven_by in zip(
                self.results, following, self.proven_by, strict=True
            )
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON: the table, the suggestion, and every result in full."""
        return {
            "status": self.status.value,
            "suggested_n_inliers": self.suggested_n_inliers,
            "warnings": self.warnings,
            "table": self.rows(),
            "results": [result.to_dict() for result in self.results],
        }

    def to_json(self, **more: Any) -> str:
        """`to_dict` and the version as JSON, with `more` keys (such as names of files)."""
        return as_json({**self.to_dict(), **more, "dcreg_version": __version__})

    def write_json(self, path: str | Path, **more: Any) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.to_json(**more) + "\n")

    def write_csv(self, path: str | Path) -> None:
        """Write `rows`, each with its final pose (T00, T01, ...); no value is an empty field."""
        rows = [
            plain(row) | {f"T{i}{j}": x for (i, j), x in np.ndenumerate(result.T_target_source)}
            for row, result in zip(self.rows(), self.results, strict=True)
        ]
        with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, rows[0])
            writer.writeheader()
            writer.writerows(rows)

    def summary(self) -> str:
        """The table, the suggestion and the warnings, in lines of plain text."""
        warnings = [f"warning: {line}" for line in self.warnings]
        return "\n".join([text.table(*self.table(), left=["status"]), *self.notes(), *warnings])

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and `rows` as they are printed."""
        flat = self.results[0].model == "similarity2d"
        headings = [
            "pairs", "status", "lower bound", "upper bound", "RMS", "next pair", "proven by",
            *([] if flat else ["RMSE of pose"]), "nodes", "time",
        ]  # fmt: skip
        suggested = self.suggested_n_inliers
        rows = [
            [
                f"{'* ' if row['n_inliers'] == suggested else ''}{row['n_inliers']}",
                row["status"],
                f"{row['lower_bound']:.5g}",
                f"{row['upper_bound']:.5g}",
                f"{row['rms_low']:.4g} to {row['rms']:.4g}",
                "" if row["next_pair"] is None else f"{row['next_pair']:.4g}",
                "" if row["proven_by"] is None else f"k={row['proven_by']}",
                *([] if flat else [f"{row['rmse_matched']:.4g}"]),
                str(row["n_nodes"]),
                f"{row['time_s']:.2f} s",
            ]
            for row in self.rows()
        ]
        return headings, rows

    def notes(self) -> list[str]:
        """What the columns of the table mean, and what it suggests."""
        suggested = self.suggested_n_inliers
        legend = (
            f"bounds on: {self.results[0].certificate_scope}; RMS: sqrt(bound / pairs), units of the "
            "target; next pair: rise of the upper bound per additional pair"
        )
        if suggested is None:
            hint = (
                "suggestion: none, nowhere between the first and the last of these cardinalities do the "
                "residuals begin to stand out"
            )
        else:
            hint = (
                f"suggestion (*), not proven: {suggested} pairs, beyond which residuals stand out "
                "from those before, as good as the poses are"
            )
        return [legend, *self._sample(), hint]

    def _sample(self) -> list[str]:
        """What was searched, where these are not all points."""
        if (searched := self.results[0].downsampled) is None:
            return []
        n, m, _ = searched
        counts = ", ".join(f"{r.n_inliers} as {r.n_bounded}" for r in self.results)
        return [
            f"downsampled to {n} and {m} farthest points: the bounds are of pairs of these ({counts}); "
            "the poses are refined on all points"
        ]

    __str__ = summary

    def __repr__(self) -> str:
        counts = [result.n_inliers for result in self.results]
        return (
            f"<SweepResult {self.status.value}: {len(counts)} cardinalities from {counts[0]} to "
            f"{counts[-1]}>"
        )


def _one_of(lines: dict[int, str], counts: list[int]) -> str:
    """One warning for the cardinalities that have it."""
    (first, line), *others = lines.items()
    if len(lines) == len(counts) and len(set(lines.values())) == 1:
        return line
    if not others:
        return f"k={first}: {line}"
    alike = "all others" if len(lines) == len(counts) else ", ".join(f"k={k}" for k, _ in others)
    return f"k={first}: {line} (likewise {alike})"


def _row(result: Result, after: Result | None, proven_by: int | None) -> dict[str, Any]:
    k = result.n_bounded
    row: dict[str, Any] = {
        "n_inliers": result.n_inliers,
        "status": result.status.value,
        "lower_bound": result.lower_bound,
        "upper_bound": result.upper_bound,
        "gap": result.gap,
        "gap_tol": result.gap_tol,
        "rms": float(np.sqrt(result.upper_bound / k)),
        "rms_low": float(np.sqrt(max(0.0, result.lower_bound) / k)),
        "rmse_matched": result.rmse_matched,
        "next_pair": None,
        "next_pair_low": None,
        "next_pair_high": None,
        "proven_by": proven_by,
        "n_nodes": result.n_nodes,
        "n_assignments": result.n_assignments,
        "time_s": result.time_solve_s,
    }
    if after is not None and (more := after.n_bounded - k) > 0:
        row["next_pair"] = (after.upper_bound - result.upper_bound) / more
        # the k cheapest of k' pairs would be better than the optimum for k if the others cost less than
        # its average pair
        floor = result.lower_bound / k
        row["next_pair_low"] = max((after.lower_bound - result.upper_bound) / more, floor)
        row["next_pair_high"] = (after.upper_bound - result.lower_bound) / more
    return row
