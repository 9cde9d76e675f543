"""The figure of 2D tests in the paper: mean error per shape, and mean time, against the level."""

from __future__ import annotations

import pandas as pd

from reports.figures import levels
from reports.figures.figure import Figure
from reports.ledger.evidence import Experiment
from reports.ledger.judging import ledger
from reports.tables import Tables
from reports.theme import Style
from workflows.disturb import DISTURBANCES

POSITION = 20
TITLE = "Paper: 2D tests"
CAPTION = (
    "Means over the trials that returned a pose, as in the paper. The levels are this project's. "
    "Bands: 10 to 90 % of the runs."
)
DRAWN = ("mean", "band", "floor")
METHODS = ("dcreg_paper", "dcreg_half", "rpm_htb", "rpm_pa", "rpm_cav")


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw the paper's methods that ran; None without such runs."""
    runs = chosen(tables, "similarity2d", METHODS)
    return None if runs.empty else levels.assemble("paper-2d", TITLE, runs, styles, scale="linear")


def chosen(tables: Tables, model: str, roles: tuple[str, ...]) -> pd.DataFrame:
    """Return runs of the paper's five tests by the methods with `roles` in the ledger."""
    experiment, known = Experiment(tables), ledger().roles
    methods = [method for role in roles for method in experiment.methods_in(known[role])]
    runs = levels.prepare(tables, model)
    return runs[runs["method"].isin(methods) & runs["test"].isin(list(DISTURBANCES))]
