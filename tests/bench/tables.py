"""``python -m tests.bench.tables RAW.json OUT``: what was measured, and the targets beside it.

OUT gets ``solves.csv`` (a row per solve), ``targets.csv``, ``targets.json`` and ``targets.md``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from tests.bench.cases import GOICP, MEDIAN

NOT_MEASURED = "not measured"
# Recorded times of official Go-ICP, 100 against 100 points, MSE threshold 0.0005.
GOICP_TRANSFORM_S, GOICP_SEARCH_S = (7.0, 9.0), (0.6, 14.0)


@dataclass(frozen=True)
class Row:
    """One line of the target table. `value` is what `target` speaks of; `met` None: no target."""

    measure: str
    target: str
    value: float
    shown: str
    met: bool | None
    remark: str = ""


def main(
    raw: Annotated[Path, typer.Argument(help="written by --benchmark-json")],
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
) -> None:
    """Print and store the tables of one benchmark run."""
    content = json.loads(raw.read_text(encoding="utf-8"))
    solves = pd.DataFrame(
        [row for one in content["benchmarks"] for row in one["extra_info"]["solves"]]
    )
    rows = targets(solves)
    out.mkdir(parents=True, exist_ok=True)
    solves.to_csv(out / "solves.csv", index=False)
    table = pd.DataFrame([asdict(row) for row in rows])
    table.to_csv(out / "targets.csv", index=False)
    machine = {key: content["machine_info"].get(key) for key in ("cpu", "python_version", "system")}
    stored = {"machine": machine, "datetime": content["datetime"], "rows": table.to_dict("records")}
    (out / "targets.json").write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    text = markdown(rows)
    (out / "targets.md").write_text(text, encoding="utf-8")
    print(text)
    print(f"tables: {out}")


def markdown(rows: list[Row]) -> str:
    lines = ["| measure | target | measured | met | remark |", "|---|---|---|---|---|"]
    for row in rows:
        met = {True: "yes", False: "no", None: "–"}[row.met]
        lines.append(f"| {row.measure} | {row.target} | {row.shown} | {met} | {row.remark} |")
    return "\n".join(lines) + "\n"


def targets(solves: pd.DataFrame) -> list[Row]:
    """Every line of the target table; what was not measured says so."""
    by_case = dict(list(solves.groupby("case", sort=False)))
    tables = (_ratios, _times, _growth, _goicp, _survey, _memory)
    return [row for table in tables for row in table(by_case)]


Cases = dict[str, pd.DataFrame]


def _ratio(
    cases: Cases, slow: str, fast: str, column: str, measure: str, least: float, stage: str = ""
) -> Row:
    """Quotients over the same subjects; at a limit the slow one is known from below only."""
    target = f"≥ {least:g}"
    if slow not in cases or fast not in cases:
        return _missing(measure, target)
    both = cases[slow].merge(cases[fast], on="subject", suffixes=("_slow", "_fast"))
    closed = both[f"{stage}status_fast"].eq("optimal")
    remark = "" if closed.all() else f"; {int((~closed).sum())} of {fast} not closed, left out"
    all_closed, both = bool(closed.all()), both[closed]
    if both.empty:
        return Row(measure, target, np.nan, NOT_MEASURED, False, remark.strip("; "))
    quotients = both[f"{column}_slow"] / both[f"{column}_fast"]
    cut = ~both[f"{stage}status_slow"].eq("optimal")
    value = float(np.exp(np.log(quotients).mean()))
    shown = f"{'at least ' if cut.any() else ''}{value:.3g} (geometric mean)"
    if cut.any():
        remark = f"; {int(cut.sum())} of {slow} at the limit{remark}"
    remark = f"{len(both)} problems, {quotients.min():.3g} … {quotients.max():.3g}{remark}"
    return Row(measure, target, value, shown, all_closed and value >= least, remark)


def _time(
    cases: Cases, name: str, measure: str, most: float, statistic: Callable = np.max, stage: str = "",
    subjects: str = "",
) -> Row:  # fmt: skip
    """A time to the certificate of matching subjects; a solve that ended at a limit has none."""
    target = f"≤ {most:g} s"
    if name not in cases:
        return _missing(measure, target)
    part = cases[name][cases[name]["subject"].str.contains(subjects)]
    times = part[f"{stage}time_s"].where(part[f"{stage}status"].eq("optimal"), np.inf)
    value = float(statistic(times))
    closed = int(np.isfinite(times).sum())
    shown = (
        f"{value:.3g} s" if np.isfinite(value) else f"not reached in {part['time_s'].max():.3g} s"
    )
    nodes = part[f"{stage or 'n_'}nodes"]
    remark = f"{closed} of {len(part)} certified, {times.min():.3g} … {times.max():.3g} s, "
    remark += f"{nodes.min():,} … {nodes.max():,} nodes"
    if closed < len(part):
        remark += "; gap left, in tolerances: " + ", ".join(
            f"{gap:.2g}" for gap in (part["gap"] / part["gap_tol"])[~np.isfinite(times)]
        )
    return Row(measure, target, value, shown, value <= most, remark)


def _missing(measure: str, target: str) -> Row:
    return Row(measure, target, np.nan, NOT_MEASURED, None, "not in this selection, or no data")


def _ratios(cases: Cases) -> list[Row]:
    """Paper / tight, and one thread / two threads."""
    rows = [
        _ratio(cases, f"{prefix}/dc", f"{prefix}/tight", column,
               f"2D, all points match: {unit}, paper / tight; {what}", 50)
        for prefix, what in (
            ("complete-safe", "fish and character, plain start box as in the paper"),
            ("complete-reduced", "fish and character, reduced start box (default)"),
            ("embedded-reduced", "embedded fish and glyph, reduced start box"),
        )
        for column, unit in (("n_assignments", "assignments"), ("time_s", "time"))
    ]  # fmt: skip
    measure = "2D, 30 % mixed outliers: time, paper / tight"
    rows.append(_ratio(cases, "mixed/dc", "mixed/tight", "time_s", measure, 40))
    rows += [
        _ratio(cases, f"{prefix}norm3d/dc", f"{prefix}norm3d/tight", "search_time_s",
               f"3D norm translation, 100 points all matched ({what}; tolerance at tau 0.01): time, "
               "paper with general assignment / tight", 300, "search_")
        for prefix, what in (("", "horse, dino"), ("embedded-", "embedded pony"))
    ]  # fmt: skip
    return rows + [
        _ratio(cases, f"{name}/tight", f"{name}/tight-2-threads", "time_s",
               f"one thread / two threads, {name} outliers: time", 1.7)
        for name in ("separate", "mixed")
    ]  # fmt: skip


def _times(cases: Cases) -> list[Row]:
    """Times to the certificate."""
    measure = f"2D, median time over {len(MEDIAN)} fish and character def and noise, one core"
    rows = [_time(cases, "median/tight", measure, 0.1, np.median)]
    rows += [
        _time(cases, f"{name}/tight{suffix}", f"2D, {what}: certificate, slowest, {threads}", 10)
        for name, what in (("separate", "separate outliers 0.6"), ("half", "n_p = 1/2"))
        for suffix, threads in (("", "one thread"), ("-2-threads", "two threads"))
    ]
    mixed = "3D, 100 inliers, noise, {}: certificate of the translation, slowest"
    all_matched = "3D, 10,000 points all matched: certificate of the translation"
    return rows + [
        _time(cases, name, measure, most, stage="search_", subjects=subjects)
        for name, measure, most, subjects in (
            ("mixed3d/tight", mixed.format("50 mixed outliers per set"), 10, r"/0\.5/.*0\.03$"),
            ("mixed3d/tight", mixed.format("100 mixed outliers per set"), 10, r"/1/.*0\.03$"),
            ("mixed3d/tight",
             mixed.format("50 mixed outliers per set, 100 times smaller tolerance"), 10, "tau"),
            ("large3d/tight", all_matched, 3, "^(?!.*tau)"),
            ("large3d/tight", f"{all_matched}, 36 times smaller tolerance", 3, "tau"),
        )
    ]  # fmt: skip


def _growth(cases: Cases) -> list[Row]:
    rows = []
    for name, what in (("growth2d/tight", "2D"), ("growth3d/tight", "3D norm")):
        measure = f"growth: nodes against points, {what}"
        if name not in cases:
            rows.append(_missing(measure, "reported"))
            continue
        part = cases[name].sort_values("n_points")
        searched = part[part["search_nodes"] > 1]  # the others were solved at the first box
        logs = np.log(searched[["n_points", "search_nodes"]].astype(float))
        slope = np.polyfit(*logs.to_numpy().T, 1)[0] if len(logs) > 1 else np.nan
        shown = ", ".join(
            f"{n:.0f}: {nodes:,}"
            for n, nodes in zip(part["n_points"], part["search_nodes"], strict=True)
        )
        rows.append(Row(measure, "reported", slope, shown, None, f"exponent {slope:.2f}"))
    return rows


def _goicp(cases: Cases) -> list[Row]:
    least = GOICP_TRANSFORM_S[0] + GOICP_SEARCH_S[0]
    measure = f"mode full on {len(GOICP)} Go-ICP cases, 100 points: total time"
    row = _time(cases, "goicp/full", measure, 15)
    remark = (
        f"{row.remark}; official Go-ICP {GOICP_TRANSFORM_S[0]:g}–{GOICP_TRANSFORM_S[1]:g} s + "
        f"{GOICP_SEARCH_S[0]:g}–{GOICP_SEARCH_S[1]:g} s on its authors' kind of machine, many-to-one"
    )
    faster = None if row.met is None else bool(row.value < least)
    return [
        Row(row.measure, row.target, row.value, row.shown, row.met, remark),
        Row("the same against official Go-ICP's fastest total", f"< {least:g} s",
            row.value, row.shown, faster),
    ]  # fmt: skip


def _survey(cases: Cases) -> list[Row]:
    rows = []
    for name in ("survey2d/tight", "survey3d/default"):
        if name not in cases:
            continue
        part = cases[name]
        closed = part["status"].eq("optimal")
        remark = "open: " + (", ".join(part.loc[~closed, "subject"]) or "none")
        rows.append(Row(f"{name}: certified within 10 s", "reported", float(closed.mean()),
                        f"{int(closed.sum())} of {len(part)}", None, remark))  # fmt: skip
    return rows


def _memory(cases: Cases) -> list[Row]:
    solves = pd.concat(cases.values())
    worst = solves.loc[solves["peak_mb"].idxmax()]
    value = float(worst["peak_mb"])
    return [
        Row("peak memory of any of the above", "≤ 1024 MB", value, f"{value:.0f} MB", value <= 1024,
            f"{worst['case']}, {worst['subject']}; whole process")
    ]  # fmt: skip


if __name__ == "__main__":
    typer.run(main)
