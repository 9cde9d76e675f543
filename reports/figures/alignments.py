"""Clouds of instances, and the source at the pose of each method over the target."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dcreg.problem import apply_pose
from reports.figures import clouds
from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.tables import Tables
from reports.theme import Style, number, words
from workflows.disturb import DISTURBANCES


def of_tests(
    identity: str,
    title: str,
    tables: Tables,
    styles: dict[str, Style],
    model: str,
    paper: PaperFigure,
) -> Figure | None:
    """Draw a row per test; the shapes alternate."""
    methods = list(paper.methods(tables).values())
    items = [item for item in tables.overlays if item["model"] == model]
    shapes = list(dict.fromkeys(item["shape"] for item in items))
    tests = [test for test in DISTURBANCES if any(item["test"] == test for item in items)]
    rows = []
    for index, test in enumerate(tests):
        found = [item for item in items if item["test"] == test]
        wanted = [item for item in found if item["shape"] == shapes[index % len(shapes)]]
        if item := example(wanted or found, methods):
            rows.append((f"{words(test)} {item['level']:g}<br>{item['shape']}", item))
    return assemble(identity, title, tables, styles, methods, rows)


def example(items: Sequence[dict[str, Any]], methods: Sequence[str]) -> dict[str, Any] | None:
    """Return the overlay whose instance is shown: the median run of the first method that has one."""
    known = [item for item in items if item["method"] in methods]

    def order(item: dict[str, Any]) -> tuple[int, bool]:
        return methods.index(item["method"]), item["rank"] != "median"

    return min(known, key=order, default=None)


def assemble(
    identity: str,
    title: str,
    tables: Tables,
    styles: Mapping[str, Style],
    methods: Sequence[str],
    rows: Sequence[tuple[str, dict[str, Any]]],
    flip: bool = False,
) -> Figure | None:
    """Draw rows of named instances and a column per method; None without rows.

    `flip` draws y downwards, as in pictures.
    """
    up = np.array([1.0, -1.0]) if flip else 1.0
    instances = tables.runs.set_index("run_id")["instance_id"]
    shown = [instances[item["run_id"]] for _, item in rows]
    known = tables.runs[tables.runs["instance_id"].isin(shown)]
    known = known.drop_duplicates(["instance_id", "method"])
    runs = {(run["instance_id"], run["method"]): run for _, run in known.iterrows()}
    methods = [method for method in methods if any((at, method) in runs for at in shown)]
    panels = []
    for row, (name, item) in enumerate(rows):
        source, target = np.array(item["source"]), np.array(item["target"])
        panels.append((row, 0, name, source * up, target * up))
        for column, method in enumerate(methods, 1):
            if (run := runs.get((shown[row], method))) is not None:
                text, moved = _aligned(run, source)
                panels.append((row, column, text, moved * up, target * up))
    titles = ["source and target", *(styles[method].name for method in methods)]
    return clouds.assemble(identity, title, titles, panels) if panels else None


def _aligned(run: pd.Series, source: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the error of a run in words, and the source at its pose."""
    if not run["T_target_source"]:
        return f"no pose<br>{words(run['status'])}", np.empty((0, source.shape[1]))
    pose = np.array(json.loads(run["T_target_source"]))
    return f"RMSE {number(run['rmse'], 2)}{'' if run['success'] else ', wrong'}", apply_pose(
        pose, source
    )
