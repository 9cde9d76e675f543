"""The figure of the tests in the paper: a source and a target of each at the reference pose."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from dcreg.problem import apply_pose
from reports.figures import clouds
from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.tables import Tables
from reports.theme import Style, words
from workflows.disturb import DISTURBANCES

POSITION = 10
TITLE = "Paper: examples of the tests"
CAPTION = (
    "Source (red circles) and target (blue crosses) at the reference pose, at the highest level."
)
DRAWN = clouds.DRAWN
PAPER = PaperFigure(
    caption="The clouds of the five tests: source and disturbed target of a shape.",
    differs=(
        "We chose the distributions of the deformation and of the outliers, following the programs that "
        "the paper cites.",
        "Both clouds are shown at the reference pose.",
    ),
    experiment="paper2d",
    command="make paper-2d",
)


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw a row per shape and a column per test; None without overlays of such tests."""
    poses = tables.runs.set_index("run_id")["T_reference"]
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for item in tables.overlays:
        key = item["shape"], item["test"]
        known = item["test"] in DISTURBANCES and json.loads(poses[item["run_id"]] or "[]")
        if known and (key not in found or item["level"] > found[key]["level"]):
            found[key] = item
    if not found:
        return None
    shapes = [shape for shape in tables.runs["shape"].unique() if any(shape == s for s, _ in found)]
    tests = [test for test in DISTURBANCES if any(test == other for _, other in found)]
    panels = []
    for (shape, test), item in sorted(found.items()):
        pose = np.array(json.loads(poses[item["run_id"]]))
        source, target = np.array(item["source"]), np.array(item["target"])
        row, column = shapes.index(shape), tests.index(test)
        back = apply_pose(np.linalg.inv(pose), target)
        panels.append((row, column, f"{shape}<br>{item['level']:g}", source, back))
    return clouds.assemble("paper-examples", TITLE, [words(test) for test in tests], panels)
