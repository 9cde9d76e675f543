"""The history page: ``python -m reports history``. One file without scripts, which opens offline."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import binomtest

from dcreg.files import write_text
from reports import templating, theme
from reports.history.steps import History, Line, Point, load
from workflows.recording import HISTORY

PLANTED = HISTORY / "planted.csv"
WIDTH, HEIGHT, EDGE = 300.0, 84.0, 10.0  # of a drawing
TONES = {"worse": "bad", "slower": "bad", "better": "good", "faster": "good", "changed": "warn"}


@dataclass(frozen=True)
class Drawing:
    """A line in SVG coordinates: parts of one machine each, dots, and the steps among them."""

    parts: list[str]
    dots: list[dict[str, Any]]


def build(out: Path, history: Path = HISTORY, planted: Path = PLANTED) -> Path:
    """Write the page of all recorded versions to the folder `out`; return its path.

    Raises
    ------
    RecordError, SchemaError
    """
    histories = load(history)
    environment = templating.environment()
    environment.filters |= {"number": theme.number}
    page = out / "index.html"
    out.mkdir(parents=True, exist_ok=True)
    text = environment.get_template("history.html").render(
        histories=histories,
        names={each.experiment: _names(each) for each in histories},
        draw=draw,
        tones=TONES,
        steps=_steps(histories),
        planted=planted_rows(planted),
        size=(WIDTH, HEIGHT),
    )
    write_text(page, text)
    return page


def draw(line: Line, versions: list[str]) -> Drawing:
    """Place the points of a line: versions evenly from left to right, values from the bottom up."""
    values = [point.value for point in line.points]
    low, high = min(values), max(values)
    if high - low < 1e-9 * max(abs(high), 1e-300):  # a constant line runs through the middle
        low, high = low - 1.0, high + 1.0
    step = (WIDTH - 2 * EDGE) / max(1, len(versions) - 1)

    def place(point: Point) -> tuple[float, float]:
        x = EDGE + step * versions.index(point.version) if len(versions) > 1 else WIDTH / 2
        return x, HEIGHT - EDGE - (HEIGHT - 2 * EDGE) * (point.value - low) / (high - low)

    parts: list[list[str]] = []
    dots, before = [], None
    for point in line.points:
        x, y = place(point)
        if before is None or (line.metric.is_time and before.machine != point.machine):
            parts.append([])
        parts[-1].append(f"{x:.1f},{y:.1f}")
        tone = TONES[point.step.verdict] if point.step else ""
        dots.append({"x": f"{x:.1f}", "y": f"{y:.1f}", "tone": tone, "point": point})
        before = point
    return Drawing([" ".join(part) for part in parts], dots)


def _names(history: History) -> dict[str, str]:
    """Return the displayed names of the methods, from their latest record."""
    return {
        method: card.get("display_name") or method
        for record in history.records.values()
        for method, card in record.about.get("methods", {}).items()
    }


def _steps(histories: list[History]) -> list[dict[str, Any]]:
    """Return a row for each step of all lines, the latest version first."""
    rows = [
        {
            "experiment": each.experiment, "method": _names(each).get(method, method),
            "title": line.metric.title, "unit": line.metric.unit, "point": point,
            "place": list(each.records).index(point.version),
        }
        for each in histories
        for method, lines in each.lines.items()
        for line in lines
        for point in line.steps
    ]  # fmt: skip
    return sorted(rows, key=lambda row: -row["place"])


def planted_rows(path: Path) -> list[dict[str, Any]]:
    """Return a row for each planted change: trials, alarms with their interval, ratios of CPU time.

    There is none if the experiment (`tests.bench.planted`) was not archived.
    """
    if not path.is_file():
        return []
    table = pd.read_csv(path)
    rows = []
    for change, part in table.groupby("change", sort=False):
        alarms = int(part["alarm"].sum())
        interval = binomtest(alarms, len(part)).proportion_ci(0.95)
        rows.append(
            {
                "change": change, "trials": len(part), "alarms": alarms,
                "by_time": int(part["alarm_time"].sum()), "by_work": int(part["alarm_work"].sum()),
                "share": theme.share(alarms / len(part), interval.low, interval.high),
                "ratio": part["similarity2d_ratio"].median(),
                "noise": 100 * part["similarity2d_noise"].median(),
            }
        )  # fmt: skip
    return rows
