"""The paper's figure of 3D tests: mean error per shape, and mean time, against the level."""

from __future__ import annotations

from reports.figures import levels, paper_2d
from reports.page import Figure
from reports.tables import Tables
from reports.theme import Style

TITLE = "3D tests"
CAPTION = paper_2d.CAPTION
DRAWN = paper_2d.DRAWN
METHODS = ("dcreg3", "dcreg3_half", "rpm_htb", "goicp", "frs", "gore", "teaser")


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """The figure, with the paper's methods as far as they ran; None without such runs."""
    runs = paper_2d.chosen(tables, "rigid3d", METHODS)
    return None if runs.empty else levels.assemble("paper-3d", TITLE, runs, styles, scale="linear")
