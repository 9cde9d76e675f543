"""The figure of 3D examples in the paper: source, target and the result of each method."""

from __future__ import annotations

from reports.figures import alignments
from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.figures.standalone import paper_3d, paper_alignments_2d
from reports.tables import Tables
from reports.theme import Style

POSITION = 45
TITLE = "Paper: 3D examples"
CAPTION = paper_alignments_2d.CAPTION
DRAWN = paper_alignments_2d.DRAWN
PAPER = PaperFigure(
    caption="The same as the figure of the 2D examples, for the two shapes in 3D.",
    differs=(
        *paper_alignments_2d.PAPER.differs,
        "All clouds are seen from one direction, which hides errors along it; the printed "
        "error does not.",
    ),
    experiment="paper3d",
    command="make paper-3d",
    lines=paper_3d.PAPER.lines,
)


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw a row per test and a column per method; None without overlays of such tests."""
    return alignments.of_tests("paper-alignments-3d", TITLE, tables, styles, "rigid3d", PAPER)
