"""Recalls on the official 3DMatch lists, and error against overlap, as tables and a figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from data.registry import dataset
from data.threedmatch.loader import Loader
from reports.figures import printing
from workflows.records import read, runs_columns
from workflows.studies.threedmatch import against_overlap, not_attempted, recalls, with_pairs


def write(tables: Path) -> None:
    """Write ``recall.csv``, ``overlap.csv`` and ``overlap.{svg,pdf}`` to a folder of tables."""
    loader = dataset("threedmatch")
    assert isinstance(loader, Loader)
    planned = read(tables / "runs.parquet", runs_columns())
    runs = with_pairs(planned, loader)
    recall, overlap = recalls(runs), against_overlap(runs)
    recall.to_csv(tables / "recall.csv", index=False)
    overlap.to_csv(tables / "overlap.csv", index=False)
    if len(recall):
        draw(overlap, tables / "overlap", loader.card.success_rmse)
        print(recall.drop(columns="method").round(2).to_string(index=False))
    for name, reason in not_attempted(planned).items():
        print(f"not run: {name}: {reason}")
    print(tables / ("overlap.svg" if len(recall) else "recall.csv"))


def draw(table: pd.DataFrame, stem: Path, threshold: float | None) -> None:
    """Draw the mean RMSE against the overlap, one panel per list and source."""
    panels = list(table.groupby(["test", "source"], sort=True))
    with printing.style():
        figure = Figure(figsize=(4.5 * len(panels), 4.2))
        axes = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
        for axis, ((test, source), panel) in zip(axes, panels, strict=True):
            for name, line in panel.groupby("display_name", sort=False):
                line = line.sort_values("level")
                axis.plot(line["level"] + 0.05, line["rmse_mean"], marker="o", ms=3, label=name)
            if threshold is not None:
                axis.axhline(threshold, color="0.5", ls="--", lw=0.8)
            axis.set(title=f"{source}, {test}", xlabel="overlap", yscale="log")
        axes[0].set_ylabel("mean RMSE of true pairs (m), runs with a pose")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    printing.save(figure, stem)
