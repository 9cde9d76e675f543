"""The figure of photographs in the paper: the source at the pose of each method, over the target."""

from __future__ import annotations

import json

import numpy as np

from dcreg.problem import apply_pose
from reports.figures import clouds
from reports.figures.figure import Figure
from reports.ledger.evidence import QUICK, Experiment
from reports.ledger.judging import ledger
from reports.tables import Tables
from reports.theme import Style

POSITION = 30
TITLE = "Paper: edges of photographs"
CAPTION = "Best, median and worst run of each method: source (red circles), target (blue crosses)."
DRAWN = clouds.DRAWN
METHODS = ("dcreg", "rpm_htb", "rpm_pa", "rpm_cav")
EXPERIMENT = "paper2d_images"
TEST = "canny"


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw a row per rank and a column per method; None in other experiments."""
    if tables.experiment.removesuffix(QUICK) != EXPERIMENT:
        return None
    experiment, known = Experiment(tables), ledger().roles
    methods = [method for role in METHODS for method in experiment.methods_in(known[role])]
    shown = [item for item in tables.overlays if item["method"] in methods and item["test"] == TEST]
    ranks = list(dict.fromkeys(item["rank"] for item in shown))
    panels = []
    for item in shown:
        pose = item["T_target_source"]
        pose = np.array(json.loads(pose) if isinstance(pose, str) else pose)
        moved = apply_pose(pose, np.array(item["source"]))
        row, column = ranks.index(item["rank"]), methods.index(item["method"])
        panels.append(
            (row, column, f"{item['rank']}<br>{item['shape']}", moved, np.array(item["target"]))
        )
    titles = [styles[method].name for method in methods]
    return clouds.assemble("paper-images", TITLE, titles, panels) if panels else None
