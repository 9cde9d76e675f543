"""Search errors and model errors, by the objective regret per method."""

from __future__ import annotations

import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.theme import Style, words
from workflows.attribution import VERDICTS, tolerance


def count(runs: pd.DataFrame, methods: list[str]) -> pd.DataFrame:
    """Count started runs per method (rows) and verdict, and summarise certified intervals of the regret.

    ``certified`` runs have such an interval; the pose of ``proven`` ones is optimal within the tolerance.
    The medians of both ends are over the certified runs, as lengths per pair.
    """
    counts = pd.crosstab(runs["method"], runs["verdict"])
    counts = counts.reindex(index=methods, columns=list(VERDICTS), fill_value=0)
    counts["started"] = counts.sum(axis=1)
    known = runs[runs["regret_at_most"].notna()]
    by_method = known.groupby("method")
    counts["certified"] = by_method.size().reindex(methods, fill_value=0)
    proven = (
        (known["regret_at_most"] <= tolerance(runs)[known.index]).groupby(known["method"]).sum()
    )
    counts["proven"] = proven.reindex(methods, fill_value=0).astype(int)
    for end in ("objective_regret", "regret_at_most"):
        per_pair = (known[end].clip(lower=0) / known["n_inliers"]) ** 0.5
        counts[end] = per_pair.groupby(known["method"]).median().reindex(methods)
    return counts


def build(runs: pd.DataFrame, styles: dict[str, Style]) -> Figure:
    """Draw RMSE against objective regret, a point per run: search errors right, model errors left."""
    judged = runs[runs["objective_regret"].notna()]
    grid, traces = Grid(column_titles=list(dict.fromkeys(judged["model"]))), []
    for column, model in enumerate(grid.column_titles):
        panel = Panel(
            0, column, "E(found) − E(best known), per pair", "RMSE", "log", "log", share_y=False
        )
        axes = grid.add(panel)
        for method, style in styles.items():
            part = judged[(judged["model"] == model) & (judged["method"] == method)]
            if part.empty:
                continue
            regret = (part["objective_regret"] / part["n_inliers"]).clip(lower=1e-8)
            text = [
                f"<b>{style.name}</b> {VERDICTS[verdict][0]}<br>"
                f"{words(test)}, level {level:g}<br>{run_id}"
                for verdict, run_id, test, level in zip(
                    part["verdict"], part["run_id"], part["test"], part["level"], strict=True
                )
            ]
            traces.append(
                {
                    "x": list(regret), "y": list(part["rmse"].clip(lower=1e-8)),
                    "xaxis": axes[0], "yaxis": axes[1], "mode": "markers", "name": style.name,
                    "text": text, "hovertemplate": "%{text}<br>RMSE %{y:.3g}<extra></extra>",
                    "marker": {"symbol": style.symbol, "size": 7, "opacity": 0.75},
                    "meta": {"role": "runs", "method": method},
                }
            )  # fmt: skip
    payload = {"views": {"": {"data": traces, "layouts": grid.layouts()}}, "scales": {}}
    return Figure("attribution", "RMSE against objective regret", "plain", payload)
