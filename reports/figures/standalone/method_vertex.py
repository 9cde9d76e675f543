"""The drawing of the bound in the paper: a minimum of concave functions over a box is at a vertex."""

from __future__ import annotations

import numpy as np

from reports.figures import method
from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.figures.paper import PaperFigure
from reports.figures.standalone.method_dc import AXIS
from reports.tables import Tables
from reports.theme import Style

POSITION = 2
TITLE = "Paper: minimum of concave functions"
CAPTION = (
    "First: the relaxed objective with the matching fixed to the optimum at one of five positions "
    "(dashed), and its minimum over all matchings (solid), on a diagonal of a box. Second: that minimum "
    f"at the vertices of the box, in ascending order; the first is the bound. {method.INSTANCE}"
)
DRAWN = method.ROLES
PAPER = PaperFigure(
    caption="For every fixed matching the relaxed objective is concave, and so is the minimum over the "
    "matchings. Over a box it is therefore attained at a vertex: one assignment per vertex gives the "
    "bound.",
    differs=(
        "The curves and values are computed by the code of the method dcreg_paper on a generated "
        "instance. The paper's drawing is schematic.",
        "It shows norm space in 3D, with eight vertices. The box of a similarity in 2D has sixteen.",
    ),
)
FIXED = (0.0, 0.25, 0.5, 0.75, 1.0)  # where matchings are optimal, from one end to the other


def build(tables: Tables | None, styles: dict[str, Style]) -> Figure:
    """Draw the functions; tables are not used."""
    found = method.section()
    grid = Grid(["on a diagonal", "at the vertices"])
    left = grid.add(Panel(0, 0, AXIS, "squared units", share_y=False))
    right = grid.add(Panel(0, 1, "vertex, by value", "squared units", share_y=False))
    traces = []
    for share in FIXED:
        columns = found.matching(round(share * (len(found.at) - 1)))
        values = found.with_matching(columns)
        traces.append(method.curve(found.at, values, left, "fixed", "one matching", dash="dash"))
    relaxed = found.relaxed()
    values = np.sort(found.at_vertices())
    order = np.arange(1, len(values) + 1)
    traces += [
        method.curve(found.at, relaxed, left, "bound", "minimum over matchings"),
        method.curve(order, values, right, "bound", "at a vertex", mode="markers"),
        method.curve(
            order[[0, -1]], np.full(2, found.bounded.lower_bound), right, "bound",
            "lower bound of the box", dash="dot",
        ),
        method.curve(found.at[:1], relaxed[:1], left, "bound", "at a vertex", mode="markers"),
    ]  # fmt: skip
    return method.assemble("method-vertex", TITLE, grid, traces)
