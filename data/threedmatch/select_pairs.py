"""How pairs.csv was chosen: ``python -m data.threedmatch.select_pairs`` prints it again.

From the official lists 3DMatch and 3DLoMatch, per scene and nominal overlap, the pair whose overlap
is nearest, among those with a rotation of 20 degrees or more when there are any.
"""

from __future__ import annotations

import csv
import sys
from typing import Any

import numpy as np

from data.fetch import fetch
from data.registry import dataset
from data.threedmatch.loader import read_metadata

LEVELS = (0.15, 0.25, 0.40, 0.55, 0.75)
MIN_ROTATION_DEG = 20.0


def _angle_deg(rotation: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


def select(lists: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """The frozen list, from the official lists by name."""
    entries = [{**entry, "set": name} for name, pairs in lists.items() for entry in pairs]
    rows = []
    for scene in sorted({entry["scene_name"] for entry in entries}):
        here = [entry for entry in entries if entry["scene_name"] == scene]
        turned = [e for e in here if _angle_deg(e["rotation"]) >= MIN_ROTATION_DEG]
        for level in LEVELS:
            best = min(turned or here, key=lambda entry: abs(entry["overlap"] - level))
            rows.append(
                {
                    "scene": scene,
                    "level": level,
                    "ref_i": best["frag_id0"],
                    "src_j": best["frag_id1"],
                    "set": best["set"],
                    "overlap": round(float(best["overlap"]), 4),
                }
            )
    return rows


def main() -> None:
    """Print the list as CSV."""
    card = dataset("threedmatch").card
    names = ("3DMatch", "3DLoMatch")
    rows = select({n: read_metadata(fetch(card.file(f"3dmatch/meta/{n}.pkl"))) for n in names})
    writer = csv.DictWriter(sys.stdout, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


if __name__ == "__main__":
    main()
