"""Figures and page of the study of bounds: ``python -m reports bounds FOLDER``.

Reads the tables of `workflows.studies.bounds` and writes ``boxes.{svg,pdf}``, ``searches.{svg,pdf}`` and
``index.html`` to their folder. The page is one file that needs no network and follows the reader's light
or dark theme.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as MplFigure

from dcreg.names import BOUND_NAMES
from reports import templating, theme
from reports.figures import printing
from reports.figures.printing import INK
from reports.tables import check_study

PLACES = {
    "centred": "boxes centred on the optimum",
    "holding": "boxes with the optimum off-centre",
    "away": "boxes without the optimum",
}
GAPS = (10.0, 3.0, 1.0, 0.3, 0.1)  # in units of the default tolerance
SHOWN_WIDTHS = (0.5, 0.05)  # in the table of losses: the nearest measured widths
_MARKERS = "osD^vPX<>d*"


@dataclass(frozen=True)
class Look:
    """The look of one bound on one surface."""

    color: str
    marker: str
    dash: str


def looks(names: list[str], surface: str) -> dict[str, Look]:
    """Return colours by the order of the names, and dashes by the kind of bound."""
    return {
        name: Look(
            theme.readable(theme.FALLBACK_COLORS[index % 7], theme.SURFACE[surface]),
            _MARKERS[index % len(_MARKERS)],
            _dash(name),
        )
        for index, name in enumerate(names)
    }


def _dash(name: str) -> str:
    """Dash term-wise bounds, dot combinations, and dash-dot methods of ``baselines/``."""
    if name.startswith("termwise"):
        return "--"
    return ":" if "+" in name else "-" if name in BOUND_NAMES else "-."


# --- figures ------------------------------------------------------------------------------------


def draw_boxes(tables: dict[str, pd.DataFrame], surface: str) -> MplFigure:
    """Draw bound value and loss against box width: a column per place, two rows per instance."""
    table = tables["losses"].dropna(subset="value")
    style = looks(list(dict.fromkeys(table["bound"])), surface)
    instances = list(dict.fromkeys(table["instance"]))
    figure = MplFigure(figsize=(11, 5.2 * len(instances)))
    axes = figure.subplots(2 * len(instances), len(PLACES), sharex=True, sharey="row")
    for i, instance in enumerate(instances):
        for c, (place, title) in enumerate(PLACES.items()):
            part = table[(table["instance"] == instance) & (table["place"] == place)]
            value, loss = axes[2 * i][c], axes[2 * i + 1][c]
            for name, line in part.sort_values("width").groupby("bound", sort=False):
                look = style[name]
                drawn = {
                    "color": look.color, "marker": look.marker, "linestyle": look.dash,
                    "markersize": 4, "linewidth": 1.4, "label": name,
                }  # fmt: skip
                value.plot(line["width"], line["value"], **drawn)
                loss.plot(line["width"], line["loss"].where(line["loss"] > 1e-9), **drawn)
            minimum = part.groupby("width")["minimum"].first()
            value.plot(
                minimum.index,
                minimum,
                color=INK[surface],
                linewidth=1,
                label="minimum objective found",
            )
            value.set_yscale("symlog", linthresh=0.1)
            value.set_title(f"{instance}:\n{title}")
            loss.set(xscale="log", yscale="log", xlabel="box width (RMS radii)")
            _guides(loss, surface)
        axes[2 * i][0].set_ylabel("lower bound")
        axes[2 * i + 1][0].set_ylabel("minimum objective − bound")
    _finish(figure, axes, surface)
    return figure


def _guides(axis: Any, surface: str) -> None:
    """Draw slopes one and two."""
    width = np.array([2e-3, 2e-1])
    for order, dash in ((1, (0, (1, 2))), (2, (0, (4, 2)))):
        axis.plot(width, 3.0 * (width / 0.2) ** order, color=INK[surface], linewidth=0.8,
                  linestyle=dash, alpha=0.6, label=f"slope {order}")  # fmt: skip


def draw_searches(tables: dict[str, pd.DataFrame], surface: str) -> MplFigure:
    """Draw gap against nodes and assignments, a row per instance."""
    table = tables["searches"]
    style = looks(list(dict.fromkeys(table["bound"])), surface)
    instances = list(dict.fromkeys(table["instance"]))
    counters = {"n_nodes": "nodes", "n_assignments": "assignments"}
    figure = MplFigure(figsize=(11, 3.4 * len(instances) + 0.6))
    axes = figure.subplots(len(instances), 2, squeeze=False, sharey="row")
    for r, instance in enumerate(instances):
        for c, (counter, title) in enumerate(counters.items()):
            axis = axes[r][c]
            for name, look in style.items():
                part = table[(table["instance"] == instance) & (table["bound"] == name)]
                axis.plot(
                    part[counter], part["gap"].clip(lower=1e-3), drawstyle="steps-post", label=name,
                    color=look.color, linestyle=look.dash, linewidth=1.4,
                )  # fmt: skip
                axis.plot(part[counter].iloc[-1:], part["gap"].clip(lower=1e-3).iloc[-1:],
                          look.marker, color=look.color, markersize=5)  # fmt: skip
            axis.axhline(1.0, color=INK[surface], linewidth=0.8, linestyle=":")
            axis.set(xscale="log", yscale="log", xlabel=title, title=instance)
        axes[r][0].set_ylabel("gap / default tolerance")
    _finish(figure, axes, surface)
    return figure


def _finish(figure: MplFigure, axes: Any, surface: str) -> None:
    handles = {
        text: handle
        for axis in np.ravel(axes)
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=6, frameon=False,
        labelcolor=INK[surface],
    )  # fmt: skip


def _drawings(draw: Callable, tables: dict[str, pd.DataFrame], stem: Path) -> dict[str, str]:
    """Return SVG text for both surfaces; the light one is also written to files named `stem`."""
    texts = {}
    for surface in ("light", "dark"):
        with printing.style(surface):
            figure = draw(tables, surface)
        text = printing.rendered(figure, "svg", surface).decode()
        texts[surface] = text[text.index("<svg") :]
        if surface == "light":
            printing.save(figure, stem, surface)
    return texts


# --- tables of the page -------------------------------------------------------------------------


def orders_rows(orders: pd.DataFrame) -> dict[str, Any]:
    wide = orders.pivot_table(
        index="bound", columns=["instance", "place"], values="order", sort=False, dropna=False
    )
    return {
        "columns": ["bound", *(", ".join(titles) for titles in wide.columns.to_list())],
        "rows": [[name, *map(theme.number, row)] for name, row in wide.iterrows()],
    }


def losses_rows(losses: pd.DataFrame) -> dict[str, Any]:
    """Loss over that of the published DC bound, for boxes with and without the optimum."""
    widths = losses["width"].unique()
    shown = {float(widths[np.abs(np.log(widths / width)).argmin()]) for width in SHOWN_WIDTHS}
    part = losses[losses["width"].isin(shown) & losses["place"].isin(("holding", "away"))]
    wide = part.assign(width=part["width"].map("{:.2g}".format)).pivot_table(
        index="bound", columns=["instance", "place", "width"], values="ratio", sort=False,
        dropna=False,
    )  # fmt: skip
    return {
        "columns": ["bound", *(", ".join(titles) for titles in wide.columns.to_list())],
        "rows": [[name, *map(theme.number, row)] for name, row in wide.iterrows()],
    }


def searches_rows(searches: pd.DataFrame, counter: str) -> dict[str, Any]:
    """Work until the gap first reached each of `GAPS`; a dash if it did not."""
    columns: list[str] = ["bound"]
    rows: dict[str, list[str]] = {}
    for instance, part in searches.groupby("instance", sort=False):
        columns += [f"{instance}, gap {gap:g} ε" for gap in GAPS]
        for name, history in part.groupby("bound", sort=False):
            reached = [history.loc[history["gap"] <= gap, counter] for gap in GAPS]
            shown = [
                theme.integer(first.iloc[0]) if len(first) else theme.MISSING for first in reached
            ]
            rows.setdefault(str(name), [str(name)]).extend(shown)
    return {"columns": columns, "rows": list(rows.values())}


# --- page ---------------------------------------------------------------------------------------


def build(folder: Path) -> Path:
    """Write figures and page for the tables in `folder`; return the path of the page."""
    tables = {
        name: pd.read_csv(folder / f"{name}.csv") for name in ("losses", "orders", "searches")
    }
    check_study(tables["searches"], folder)
    tables["searches"] = tables["searches"].query("trial == 0")  # the trial whose boxes are bounded
    figures = []
    for name, draw, title, caption in (
        ("boxes", draw_boxes, "Bound value against box width",
         "Means over the boxes of one width that contain the optimum, or lie away from it. The loss of a "
         "bound decreases with the width; a steeper line means faster convergence. Exact bounds have no "
         "loss and are omitted from the loss panels."),
        ("searches", draw_searches, "Work to a given gap",
         "Best-first search with every bound in the first trial, with the same root box, incumbent and "
         "branching. A search ends at a tenth of the tolerance or at the time limit; a marker shows it."),
    ):  # fmt: skip
        drawn = _drawings(draw, tables, folder / name)
        figures.append({"id": name, "title": title, "caption": caption} | drawn)
    shown = [
        {"id": "losses", "title": "Loss relative to the published DC bound",
         "caption": "Mean loss (minimum objective found − bound), divided by the mean loss of the "
         "bound `dc`, for boxes of one width (in RMS radii) that contain the optimum or lie away from "
         "it. A dash means that there is no bound for these boxes."} | losses_rows(tables["losses"]),
        {"id": "orders", "title": "Empirical order of convergence",
         "caption": "Slope of log loss over log width at the smallest widths with a loss above a "
         "thousandth of the optimum."} | orders_rows(tables["orders"]),
        {"id": "nodes", "title": "Nodes to a given gap",
         "caption": "ε is the default tolerance. A dash means that the gap was not reached in time."}
        | searches_rows(tables["searches"], "n_nodes"),
        {"id": "assignments", "title": "Assignments to a given gap", "caption": "See the previous table."}
        | searches_rows(tables["searches"], "n_assignments"),
    ]  # fmt: skip
    page = folder / "index.html"
    page.write_text(
        templating.environment()
        .get_template("bounds_study.html")
        .render(figures=figures, tables=shown),
        encoding="utf-8",
    )
    return page
