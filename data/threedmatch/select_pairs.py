"""Make the tables of pairs: ``python -m data.threedmatch.select_pairs`` prints pairs.csv.

With the argument ``lists`` it prints lists.csv: the official lists 3DMatch and 3DLoMatch in their order.
The rows of pairs.csv are, per scene and nominal overlap, the pair of these lists with the nearest
overlap, among those with a rotation of at least 20 degrees if there are any.
"""

from __future__ import annotations

import csv
import sys
from typing import Any

from data.fetch import fetch
from data.registry import dataset
from data.threedmatch.loader import LISTS, read_metadata
from dcreg.problem import rotation_angle_deg

LEVELS = (0.15, 0.25, 0.40, 0.55, 0.75)
MIN_ROTATION_DEG = 20.0


def select(lists: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the frozen list, from the official lists by name."""
    entries = [{**entry, "set": name} for name, pairs in lists.items() for entry in pairs]
    rows = []
    for scene in sorted({entry["scene_name"] for entry in entries}):
        here = [entry for entry in entries if entry["scene_name"] == scene]
        turned = [e for e in here if rotation_angle_deg(e["rotation"]) >= MIN_ROTATION_DEG]
        for level in LEVELS:
            best = min(turned or here, key=lambda entry: abs(entry["overlap"] - level))
            rows.append({"scene": scene, "level": level, **_row(best)})
    return rows


def official(lists: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """All pairs of the official lists, in their order."""
    return [
        {"scene": entry["scene_name"], **_row({**entry, "set": name})}
        for name, pairs in lists.items()
        for entry in pairs
    ]


def _row(entry: dict[str, Any]) -> dict[str, Any]:
    return {
        "ref_i": entry["frag_id0"],
        "src_j": entry["frag_id1"],
        "set": entry["set"],
        "overlap": round(float(entry["overlap"]), 4),
    }


def main() -> None:
    """Print a table as CSV."""
    card = dataset("threedmatch").card
    lists = {n: read_metadata(fetch(card.file(f"3dmatch/meta/{n}.pkl"))) for n in LISTS}
    rows = official(lists) if sys.argv[1:] == ["lists"] else select(lists)
    writer = csv.DictWriter(sys.stdout, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


if __name__ == "__main__":
    main()
