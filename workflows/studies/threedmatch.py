"""Compute both published recalls on the official 3DMatch lists, and errors against overlap per source.

``python -m reports threedmatch EXPERIMENT`` writes the tables and draws them.
"""

from __future__ import annotations

import pandas as pd

from data.threedmatch.loader import Loader
from workflows.outcomes import attempted, comparable_times

# Errors below which a pose is right; the translation error is in metres.
MAX_ROTATION_DEG, MAX_TRANSLATION = 15.0, 0.3
SOURCES = {"7-scenes": "7-Scenes", "sun3d": "SUN3D"}


def with_pairs(runs: pd.DataFrame, loader: Loader) -> pd.DataFrame:
    """Return attempted runs on the official lists with overlap, source and both verdicts."""
    runs = attempted(runs.assign(time_solve_s=comparable_times(runs)))
    runs = runs[runs["test"] != "overlap"].copy()
    keys = runs[["shape", "test", "level", "trial"]].itertuples(index=False, name=None)
    pairs = [loader.pairs[key] for key in keys]
    runs["overlap"] = [float(pair["overlap"]) for pair in pairs]
    runs["is_apart"] = [abs(int(pair["ref_i"]) - int(pair["src_j"])) > 1 for pair in pairs]
    runs["source"] = [
        next(title for name, title in SOURCES.items() if scene.startswith(name))
        for scene in runs["shape"]
    ]
    runs["is_right"] = (runs["rotation_error_deg"] < MAX_ROTATION_DEG) & (
        runs["translation_error"] < MAX_TRANSLATION
    )
    runs["is_registered"] = runs["rmse"] < loader.card.success_rmse
    return runs


def recalls(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row per list and method, best first.

    ``recall_pairs_pct``: share of pairs within both limits on the pose. ``recall_scenes_pct``: mean over
    scenes of the share with an RMSE below the published threshold (``success_rmse`` on the card), among
    pairs that are not neighbours in the recording.
    """
    rows = []
    for (test, method), group in runs.groupby(["test", "method"], sort=False):
        right = group[group["is_right"]]
        by_scene = group[group["is_apart"]].groupby("shape")["is_registered"].mean()
        rows.append(
            {
                "test": test,
                "method": method,
                "display_name": group["display_name"].iloc[0],
                "pairs": len(group),
                "recall_pairs_pct": 100 * group["is_right"].mean(),
                "recall_scenes_pct": 100 * by_scene.mean(),
                "rotation_error_deg": right["rotation_error_deg"].mean(),
                "translation_error_cm": 100 * right["translation_error"].mean(),
                "certified_pct": 100 * (group["status"] == "optimal").mean(),
                "limited_pct": 100 * (group["outcome"] == "limited").mean(),
                "time_median_s": group["time_solve_s"].median(),
                "time_max_s": group["time_solve_s"].max(),
            }
        )
    if not rows:
        return pd.DataFrame(columns=["test", "method"])
    table = pd.DataFrame(rows)
    return table.sort_values(["test", "recall_pairs_pct"], ascending=[True, False])


def not_attempted(runs: pd.DataFrame) -> dict[str, str]:
    """Return the methods without an attempted run, with the reason."""
    left = runs[~runs["method"].isin(attempted(runs)["method"])]
    return dict(zip(left["display_name"], left["message"], strict=True))


def against_overlap(runs: pd.DataFrame) -> pd.DataFrame:
    """Return mean and median RMSE and recall per list, source, method and bin of overlap.

    Recall is over all ``pairs``; errors are over the ``poses``, the pairs for which a pose was returned.
    """
    groups = runs.groupby(["test", "source", "method", "display_name", "level"], sort=False)
    return groups.agg(
        pairs=("rmse", "size"),
        poses=("rmse", "count"),
        rmse_mean=("rmse", "mean"),
        rmse_median=("rmse", "median"),
        recall=("is_right", "mean"),
    ).reset_index()
