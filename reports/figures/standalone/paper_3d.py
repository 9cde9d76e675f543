"""The figure of 3D tests in the paper: mean error per shape, and mean time, against the level."""

from __future__ import annotations

from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.figures.standalone import paper_2d
from reports.tables import Tables
from reports.theme import Style

POSITION = 40
TITLE = "Paper: 3D tests"
CAPTION = paper_2d.CAPTION
DRAWN = paper_2d.DRAWN
PAPER = PaperFigure(
    caption="The same as the figure of the 2D tests, for two shapes in 3D and five other methods.",
    differs=(
        "The paper states neither its levels nor its number of points, time limits, tolerances and start "
        "boxes; ours are in the protocol. More than 0.5 outliers per inlier are beyond its axes.",
        "Our reconstruction of HBSP searches the rotation for the translation found. It usually "
        "ends at the limit, so DC-Reg and RPM-HTB spend most of their time in this reconstruction, not "
        "in the published search.",
        "RPM-HTB is a reconstruction. FRS is our own implementation of the nested search of Parra Bustos "
        "et al.; we infer that the paper means this search.",
        "RPM-HTB is drawn with a pose fit to each relaxed matching; we do not know whether the original "
        "does this. The tables also contain RPM-HTB without these fits.",
        "The paper does not state the correspondences of GORE and TEASER++. Ours come from norm "
        "signatures, or from FPFH where the name says so.",
        "DC-Reg (ours), the dashed floor and the bands are added.",
    ),
    experiment="paper3d",
    command="make paper-3d",
    lines=(
        "DC-Reg, n_p × 1/1", "DC-Reg, n_p × 1/2", "DC-Reg (ours)", "RPM-HTB", "Go-ICP", "FRS", "GORE",
        "TEASER++",
    ),
)  # fmt: skip


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw the paper's methods that ran; None without such runs."""
    return paper_2d.statistics("paper-3d", TITLE, tables, styles, "rigid3d", PAPER)
