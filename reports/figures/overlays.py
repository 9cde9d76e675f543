"""Source and target before and after, for the best, median and worst run per method and test."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from reports.figures.figure import Figure
from reports.pairs import OWN_TEST
from reports.tables import Tables, row_names
from reports.theme import Style, number, words


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Return point sets, each stored once, and the poses that refer to them; None without overlays."""
    if not tables.overlays:
        return None
    names = dict(zip(tables.runs["run_id"], row_names(tables.runs), strict=True))
    clouds: dict[str, int] = {}
    groups = zip(tables.runs["model"], tables.runs["test"], strict=True)
    tests = {key: i for i, key in enumerate(dict.fromkeys(groups))}
    methods = {method: i for i, method in enumerate(tables.methods)}
    ordered = sorted(
        tables.overlays,
        key=lambda item: (tests[item["model"], item["test"]], methods[item["method"]]),
    )
    cases = [_case(item, clouds, styles, names) for item in ordered]
    payload = {"clouds": [json.loads(text) for text in clouds], "cases": cases}
    return Figure("overlays", "Overlays before and after", "overlays", payload)


def _case(
    item: dict[str, Any],
    clouds: dict[str, int],
    styles: dict[str, Style],
    names: dict[str, str],
) -> dict[str, Any]:
    source, target = np.asarray(item["source"], float), np.asarray(item["target"], float)
    extent = float(np.ptp(np.vstack([source, target]), axis=0).max()) or 1.0
    digits = max(0, 3 - int(np.floor(np.log10(extent))))  # a thousandth of the picture
    pose = item.get("T_target_source")
    pose = json.loads(pose) if isinstance(pose, str) and pose else pose or None
    return {
        "run": item["run_id"],
        "method": item["method"],
        "name": styles[item["method"]].name,
        "shape": item["shape"]
        if item["test"] == OWN_TEST
        else names.get(item["run_id"], item["shape"]),
        "test": item["test"],
        "level": item["level"],
        "trial": item["trial"],
        "title": f"{item['rank']} run of {words(item['test'])}",
        "rank": item["rank"],
        "rmse": number(item.get("rmse")),
        "status": item["status"],
        "model": item["model"],
        "replay": item.get("replay", ""),
        "dim": int(source.shape[1]),
        "source": _share(clouds, source, digits),
        "target": _share(clouds, target, digits),
        "pose": pose,
    }


def _share(clouds: dict[str, int], points: np.ndarray, digits: int) -> int:
    """Return the index of a point set among those already stored."""
    text = json.dumps(points.round(digits).tolist())
    return clouds.setdefault(text, len(clouds))
