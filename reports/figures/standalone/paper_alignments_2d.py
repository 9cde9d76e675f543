"""The figure of 2D examples in the paper: source, target and the result of each method."""

from __future__ import annotations

from reports.figures import alignments, clouds
from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.figures.standalone import paper_2d
from reports.tables import Tables
from reports.theme import Style

POSITION = 25
TITLE = "Paper: 2D examples"
CAPTION = (
    "One instance per test: both clouds, then the source (red circles) at the pose of each method over "
    "the target (blue crosses). The instance is the median run of the first method. A pose is marked as "
    "wrong if its error above the floor is at least 0.05 of the longest side."
)
DRAWN = clouds.DRAWN
PAPER = PaperFigure(
    caption="Examples of the tests, with the alignment that each method finds.",
    differs=(
        "The paper chose its examples. We show the run of median error.",
        "DC-Reg (ours) and the errors are added.",
    ),
    experiment="paper2d",
    command="make paper-2d",
    lines=paper_2d.PAPER.lines,
)


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw a row per test and a column per method; None without overlays of such tests."""
    return alignments.of_tests("paper-alignments-2d", TITLE, tables, styles, "similarity2d", PAPER)
