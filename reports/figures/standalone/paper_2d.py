"""The figure of 2D tests in the paper: mean error per shape, and mean time, against the level."""

from __future__ import annotations

from reports.figures import levels
from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.tables import Tables
from reports.theme import Style
from workflows.disturb import DISTURBANCES

POSITION = 20
TITLE = "Paper: 2D tests"
CAPTION = (
    "Mean RMSE and mean time over the trials that returned a pose, as in the paper, and the RMSE of the "
    "fit to the true pairs (dashed). The levels are this project's. Bands: 10 to 90 % of the runs."
)
DRAWN = ("mean", "band", "floor")
PAPER = PaperFigure(
    caption="Mean error of the true pairs for two shapes, a row each, and mean time below, against the "
    "level of five disturbances, with all and with half of the true number of pairs.",
    differs=(
        "The paper states neither its levels nor its number of points, time limits, tolerances and start "
        "boxes; ours are in the protocol. More than 0.5 outliers per inlier are beyond its axes.",
        "We added DC-Reg (ours). RPM-HTB, RPM-PA and RPM-CAV are our reconstructions.",
        "RPM-HTB is drawn with a pose fit to each relaxed matching; we do not know whether the original "
        "does this. The tables also contain RPM-HTB without these fits.",
        "Times are those of our programs on the machine named below; the paper used MATLAB.",
        "We added the dashed floor and the bands.",
    ),
    experiment="paper2d",
    command="make paper-2d",
    lines=(
        "DC-Reg, n_p × 1/1",
        "DC-Reg, n_p × 1/2",
        "DC-Reg (ours)",
        "RPM-HTB",
        "RPM-PA",
        "RPM-CAV",
    ),
)


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw the paper's methods that ran; None without such runs."""
    return statistics("paper-2d", TITLE, tables, styles, "similarity2d", PAPER)


def statistics(
    identity: str,
    title: str,
    tables: Tables,
    styles: dict[str, Style],
    model: str,
    paper: PaperFigure,
) -> Figure | None:
    """Draw the runs of the paper's five tests by the methods of its figure."""
    runs = levels.prepare(tables, model)
    shown = runs["method"].isin(paper.methods(tables).values())
    runs = runs[shown & runs["test"].isin(list(DISTURBANCES))]
    return None if runs.empty else levels.assemble(identity, title, runs, styles, scale="linear")
