"""The drawing of the decomposition in the paper: convex part, tangent, concave part, lower bound."""

from __future__ import annotations

import numpy as np

from reports.figures import method
from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.figures.paper import PaperFigure
from reports.tables import Tables
from reports.theme import Style

POSITION = 1
TITLE = "Paper: difference of convex functions"
CAPTION = (
    "In order: the convex part of the cost of one pair with its tangent at the centre of the "
    "box; the concave part; the cost, and the tangent plus the concave part below it; the objective over "
    "all pairs, and the relaxed objective, whose minimum over the vertices of the box is the bound. "
    f"All are functions of the position on a diagonal of the box. {method.INSTANCE}"
)
DRAWN = method.ROLES
PAPER = PaperFigure(
    caption="A pair's cost is a convex function plus a concave one. The tangent of the convex part at "
    "the centre of a box replaces it, so the sum is concave and lies below the cost.",
    differs=(
        "The curves are computed by the code of the method dcreg_paper on a generated instance, along "
        "a diagonal of a box that its search bounded. The paper's drawing is schematic.",
        "It shows norm space in 3D. In 2D the concave part of the cost of a pair is affine, and so is "
        "its lower bound.",
    ),
)
AXIS = "position on the diagonal"


def build(tables: Tables | None, styles: dict[str, Style]) -> Figure:
    """Draw the functions; tables are not used."""
    found = method.section()
    source = most_curved(found)
    target = int(found.matching(len(found.at) // 2)[source])
    reach, norm = found.norms[:, source], found.space.norms[target]
    convex, concave = reach**2, norm**2 - 2 * norm * reach
    tangent = convex - found.dropped
    total, relaxed, ends = found.objective(), found.relaxed(), found.at[[0, -1]]
    grid = Grid(["convex part", "concave part", "cost of a pair", "all pairs"])
    first, second, third, last = (
        grid.add(Panel(0, column, AXIS, title, share_y=False))
        for column, title in enumerate(("squared units", "", "", ""))
    )
    at, draw = found.at, method.curve
    traces = [
        draw(at, convex, first, "convex", "convex part"),
        draw(at, tangent, first, "convex", "its tangent at the centre", dash="dash"),
        draw(at, concave, second, "concave", "concave part"),
        draw(at, convex + concave, third, "objective", "cost, objective"),
        draw(at, tangent + concave, third, "bound", "tangent plus concave part"),
        draw(at, total, last, "objective", "cost, objective"),
        draw(at, relaxed, last, "bound", "tangent plus concave part"),
        draw(
            ends, np.full(2, found.bounded.lower_bound), last, "bound", "lower bound of the box",
            dash="dot",
        ),
        draw(
            at[:1], relaxed[:1], last, "bound", "minimising vertex", mode="markers",
        ),
    ]  # fmt: skip
    return method.assemble("method-dc", TITLE, grid, traces)


def most_curved(found: method.Section) -> int:
    """Return the matched source point whose distance from the origin bends most on the diagonal."""
    matched = np.flatnonzero(found.matching(len(found.at) // 2) >= 0)
    norms = found.norms[:, matched]
    bend = norms[0] + norms[-1] - 2 * norms[len(norms) // 2]
    return int(matched[bend.argmax()])
