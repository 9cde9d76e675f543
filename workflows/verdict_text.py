"""Show the verdicts of a comparison: in the terminal, as Markdown for a pull request, and as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any

import pandas as pd

from dcreg.files import plain
from workflows.compare import TIMED_WORDS, Verdict, regressed

STYLES = {"worse": "bold red", "better": "green", "changed": "yellow", "unclear": "yellow"}
MOST_NAMES = 5  # of instances in the terminal
MOST_LISTED = 50  # of instances per verdict in Markdown


def outcome(verdicts: pd.DataFrame) -> str:
    """Return the result of the comparison in a few words."""
    counts = verdicts["verdict"].value_counts()
    worse = int(counts.get("worse", 0))
    kinds = ("better", "changed", *TIMED_WORDS, "unclear", "not compared")
    others = [f"{counts[word]} {word}" for word in kinds if word in counts]
    first = f"{worse} regression{'s' * (worse != 1)}" if worse else "no regression"
    skipped = verdicts.groupby("method", sort=False)["skipped"].sum()
    left_out = [f"{count} runs of {method}" for method, count in skipped.items() if count]
    tail = f"; left out: {', '.join(left_out)}" if left_out else ""
    return ", ".join([first, *others]) + tail


def print_verdicts(verdicts: pd.DataFrame, base: str, head: str) -> None:
    """Print every verdict that is not ``same``, the instances that differ, and a summary line."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=None if os.isatty(1) else 140)
    for experiment, group in verdicts.groupby("experiment", sort=False):
        title = escape(f"{experiment}: {base} → {head}")
        table = Table(title=title, title_justify="left")
        for column in (
            "method",
            "metric",
            "unit",
            "better is",
            "base",
            "head",
            "verdict",
            "detail",
        ):
            table.add_column(column, justify="right" if column in ("base", "head") else "left")
        for row in _rows(group):
            if row.verdict == "same":
                continue
            style = STYLES.get(row.verdict, "")
            table.add_row(
                *(escape(row.method), row.metric, row.unit, row.better),
                *(f"{row.base:.6g}", f"{row.head:.6g}"),
                f"[{style}]{row.verdict}[/]" if style else row.verdict,
                escape("\n".join([row.detail, *_named(row, MOST_NAMES)]).strip()),
            )
        if table.row_count:
            console.print(table)
        same = int((group["verdict"] == "same").sum())
        console.print(escape(f"{experiment}: {same} of {len(group)} metrics are the same"))
    console.print(outcome(verdicts))


def markdown(verdicts: pd.DataFrame, base: str, head: str) -> str:
    """Return Markdown for a pull request: outcome, table of differences, foldable lists of instances."""
    sign = "❌" if regressed(verdicts) else "✅"
    lines = [f"### {sign} {base} → {head}: {outcome(verdicts)}", ""]
    different = [row for row in _rows(verdicts) if row.verdict != "same"]
    if different:
        lines += [
            "| experiment | method | metric | unit | better is | base | head | verdict | detail |",
            "|---|---|---|---|---|--:|--:|---|---|",
        ]
    for row in different:
        word = f"**{row.verdict}**" if row.verdict == "worse" else row.verdict
        cells = [row.experiment, row.method, row.metric, row.unit, row.better]
        cells += [f"{row.base:.5g}", f"{row.head:.5g}", word, row.detail]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    same = len(verdicts) - len(different)
    lines += ["", f"{same} of {len(verdicts)} metrics are the same.", ""]
    listed = [row for row in different if row.verdict == "worse" and (row.lost or row.won)]
    for row in listed:
        lines += [f"<details><summary>{row.method}, {row.metric}: instances</summary>", ""]
        lines += [f"- {line}" for line in _named(row, MOST_LISTED)] + ["", "</details>", ""]
    return "\n".join(lines)


def as_json(verdicts: pd.DataFrame, base: str, head: str) -> str:
    """Return the verdicts for other programs, with all instances that differ."""
    content: dict[str, Any] = {
        "base": base,
        "head": head,
        "outcome": "regression" if regressed(verdicts) else "no regression",
        "verdicts": verdicts.to_dict("records"),
    }
    return json.dumps(plain(content), indent=1, ensure_ascii=False) + "\n"


def _rows(verdicts: pd.DataFrame) -> list[Verdict]:
    return [Verdict(*row) for row in verdicts.itertuples(index=False)]


def _named(row: Verdict, most: int) -> list[str]:
    """Return lines with the instances that were lost and won."""
    return [
        f"{word}: {_listed(names, most)}"
        for word, names in (("lost", row.lost), ("won", row.won))
        if names
    ]


def _listed(names: Sequence[str], most: int) -> str:
    more = [f"and {len(names) - most} more"] if len(names) > most else []
    return ", ".join([*names[:most], *more])
