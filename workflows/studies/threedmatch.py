"""Both published recalls on the official 3DMatch lists, and error against overlap per source.

``python -m workflows.studies.threedmatch EXPERIMENT`` reads the tables of an experiment on these lists,
or of the part that the options of ``workflows run`` choose, and writes beside them ``recall.csv``,
``overlap.csv`` and the figure ``overlap.pdf`` and ``.svg``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from data.registry import dataset
from data.threedmatch.loader import Loader
from workflows import CHECKOUT
from workflows.config import load, parse_selection
from workflows.outcomes import attempted
from workflows.stages.plan import expand

ANGLE_DEG, LENGTH = 15.0, 0.3  # a pose within both is right
RMSE = 0.2  # of true pairs, below which a pair counts as registered
SOURCES = {"7-scenes": "7-Scenes", "sun3d": "SUN3D"}


def with_pairs(runs: pd.DataFrame, loader: Loader) -> pd.DataFrame:
    """Attempted runs on the official lists, with the overlap, the source and both verdicts of each."""
    runs = attempted(runs[runs["test"] != "overlap"]).copy()
    keys = runs[["shape", "test", "level", "trial"]].itertuples(index=False, name=None)
    pairs = [loader.pairs[key] for key in keys]
    runs["overlap"] = [float(pair["overlap"]) for pair in pairs]
    runs["is_apart"] = [abs(int(pair["ref_i"]) - int(pair["src_j"])) > 1 for pair in pairs]
    runs["source"] = [
        next(title for name, title in SOURCES.items() if scene.startswith(name))
        for scene in runs["shape"]
    ]
    runs["is_right"] = (runs["rotation_error_deg"] < ANGLE_DEG) & (
        runs["translation_error"] < LENGTH
    )
    runs["is_registered"] = runs["rmse"] < RMSE
    return runs


def recalls(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for every list and method, the best first.

    ``recall_pairs_pct``: share of pairs within 15 degrees and 30 cm. ``recall_scenes_pct``: mean over
    scenes of the share with RMSE below 0.2 m, of pairs that are not neighbours in the recording.
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
    """Methods with no attempted run, and why."""
    left = runs[~runs["method"].isin(attempted(runs)["method"])]
    return dict(zip(left["display_name"], left["message"], strict=True))


def against_overlap(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean and median RMSE and recall for every list, source, method and bin of overlap.

    Recall is over all ``pairs``, the errors over those that the method gave one of the ``poses`` for.
    """
    groups = runs.groupby(["test", "source", "method", "display_name", "level"], sort=False)
    return groups.agg(
        pairs=("rmse", "size"),
        poses=("rmse", "count"),
        rmse_mean=("rmse", "mean"),
        rmse_median=("rmse", "median"),
        recall=("is_right", "mean"),
    ).reset_index()


def draw(table: pd.DataFrame, path: Path) -> None:
    """Mean RMSE of poses against overlap, a panel for every list and source, as PDF and SVG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = list(table.groupby(["test", "source"], sort=True))
    figure = Figure(figsize=(4.5 * len(panels), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    for axis, ((test, source), panel) in zip(axes, panels, strict=True):
        for name, line in panel.groupby("display_name", sort=False):
            line = line.sort_values("level")
            axis.plot(line["level"] + 0.05, line["rmse_mean"], marker="o", ms=3, label=name)
        axis.axhline(RMSE, color="0.5", ls="--", lw=0.8)
        axis.set(title=f"{source}, {test}", xlabel="overlap", yscale="log")
    axes[0].set_ylabel("mean RMSE of true pairs (m), where there is a pose")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    for kind in ("pdf", "svg"):
        figure.savefig(path.with_suffix(f".{kind}"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiment", nargs="?", default="threedmatch", help="as in workflows run")
    axes = ("methods", "datasets", "tests")
    for axis in axes:
        parser.add_argument(f"--{axis}", default="", help="as in workflows run")
    parser.add_argument("--directory", type=Path, default=CHECKOUT, help="where results/ lies")
    given = parser.parse_args()
    select = [f"{axis}={getattr(given, axis)}" for axis in axes if getattr(given, axis)]
    plan = expand(load(given.experiment), parse_selection(select))
    tables = given.directory / "results" / plan.experiment.name / plan.view / "tables"
    loader = dataset("threedmatch")
    assert isinstance(loader, Loader)
    planned = pd.read_parquet(tables / "runs.parquet")
    runs = with_pairs(planned, loader)
    recall, overlap = recalls(runs), against_overlap(runs)
    recall.to_csv(tables / "recall.csv", index=False)
    overlap.to_csv(tables / "overlap.csv", index=False)
    if len(recall):
        draw(overlap, tables / "overlap")
        print(recall.drop(columns="method").round(2).to_string(index=False))
    for name, reason in not_attempted(planned).items():
        print(f"not run: {name}: {reason}")
    print(tables / ("overlap.svg" if len(recall) else "recall.csv"))


if __name__ == "__main__":
    main()
