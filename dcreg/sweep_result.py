"""What a sweep over cardinalities returns: one result each, a table of them, a suggestion."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.files import as_json, plain, whole_file, write_text
from dcreg.result import Result
from dcreg.status import Status

# An elbow must lie below the chord of the curve by at least this share of the curve's height.
_CLEAR_BEND = 0.1
# A curve that rises by less than this share of the tolerated residual rises by rounding alone.
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
        """Elbow of the RMSE of the final poses: a suggestion, nothing is proven about it.

        The cardinality farthest below the chord between the ends of the curve; None where the
        curve has no clear bend.
        """
        k = np.array([r.n_inliers for r in self.results], dtype=float)
        rmse = np.array([r.rmse_matched for r in self.results])
        height = rmse[-1] - rmse[0]
        tolerated = np.sqrt(self.results[-1].gap_tol / k[-1])
        if len(k) < 3 or height <= _ROUNDING * tolerated:
            return None
        below = rmse[0] + height * (k - k[0]) / (k[-1] - k[0]) - rmse
        at = int(np.argmax(below))
        return int(k[at]) if below[at] >= _CLEAR_BEND * height else None

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
        """The table and the suggestion, in lines of plain text."""
        return "\n".join([text.table(*self.table(), left=["status"]), *self.notes()])

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
            hint = "suggestion: none, the RMSE of the poses has no clear elbow over these cardinalities"
        else:
            hint = (
                f"suggestion (*), not proven: {suggested} pairs, the elbow of the RMSE of the poses"
            )
        return [legend, hint]

    __str__ = summary

    def __repr__(self) -> str:
        counts = [result.n_inliers for result in self.results]
        return (
            f"<SweepResult {self.status.value}: {len(counts)} cardinalities from {counts[0]} to "
            f"{counts[-1]}>"
        )


def _row(result: Result, after: Result | None, proven_by: int | None) -> dict[str, Any]:
    k = result.n_inliers
    row: dict[str, Any] = {
        "n_inliers": k,
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
    if after is not None:
        more = after.n_inliers - k
        row["next_pair"] = (after.upper_bound - result.upper_bound) / more
        # the k cheapest of k' pairs would be better than the optimum for k if the others cost less than
        # its average pair
        floor = result.lower_bound / k
        row["next_pair_low"] = max((after.lower_bound - result.upper_bound) / more, floor)
        row["next_pair_high"] = (after.upper_bound - result.lower_bound) / more
    return row
