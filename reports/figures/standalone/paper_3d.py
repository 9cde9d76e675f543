"""The figure of 3D tests in the paper: mean error per shape, and mean time, against the level."""

from __future__ import annotations

from reports.figures import levels
from reports.figures.figure import Figure
from reports.figures.standalone import paper_2d
from reports.tables import Tables
from reports.theme import Style

POSITION = 40
TITLE = "Paper: 3D tests"
CAPTION = paper_2d.CAPTION
DRAWN = paper_2d.DRAWN
METHODS = ("dcreg3", "dcreg3_half", "rpm_htb", "goicp", "frs", "gore", "teaser")


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw the paper's methods that ran; None without such runs."""
    runs = paper_2d.chosen(tables, "rigid3d", METHODS)
    return None if runs.empty else levels.assemble("paper-3d", TITLE, runs, styles, scale="linear")
