"""Whose fault is an error: the search's or the model's? Objective regret, per method."""

from __future__ import annotations

import pandas as pd

from reports.figures.grid import Grid, Panel
from reports.page import Figure
from reports.tables import POSE_SCOPES, Tables
from reports.theme import Style, words

# verdict -> (heading, explanation)
VERDICTS = {
    "right": ("right pose", "pose within the success threshold, objective as good as any known"),
    "right_not_optimal": (
        "right, not optimal",
        "pose within the success threshold although a lower objective is known",
    ),
    "search_error": (
        "search error",
        "wrong pose, and a pose with a clearly lower objective exists: E(found) > E(best) + tol",
    ),
    "model_error": (
        "model error",
        "wrong pose that the objective prefers to the truth: E(found) ≤ E(true)",
    ),
    "undecided": (
        "undecided",
        "wrong pose, objective within the tolerance of the best known but above E(true)",
    ),
}


def judge(runs: pd.DataFrame) -> pd.DataFrame:
    """Add `verdict`, `certified` (an optimum is proved for the instance) and `excess`.

    The reference for an instance and number of inliers is the least objective value known: of any
    method, of the true pose, and of a certified optimum. Each is an upper bound on the optimum,
    so an objective above it by more than the tolerance proves a search error, certified or not;
    only a certificate can prove the opposite.
    """
    key = ["instance_id", "n_inliers"]
    posed = runs[runs["objective"].notna() & runs["rmse"].notna()]
    proved = runs[runs["status"].eq("optimal") & runs["certificate_scope"].isin(POSE_SCOPES)]
    optimum = proved.groupby(key).agg(best=("upper_bound", "min"), tol=("gap_tol", "min"))
    posed = posed.join(optimum, on=key)
    certified = posed["best"].notna()
    best = posed[["best", "objective_best", "objective_true"]].min(axis=1)
    fallback = posed.groupby(key)["gap_tol"].transform("min")
    tolerance = posed["tol"].fillna(fallback).fillna(0.01 * posed["objective_true"].abs())
    tolerance = tolerance.fillna(0.0) + 1e-9 * (1 + best.abs())
    excess = posed["objective"] - best
    verdict = pd.Series("undecided", index=posed.index)
    behind = excess > tolerance
    verdict[~posed["success"] & (posed["objective"] <= posed["objective_true"])] = "model_error"
    verdict[~posed["success"] & behind] = "search_error"
    verdict[posed["success"] & ~behind] = "right"
    verdict[posed["success"] & behind] = "right_not_optimal"
    return posed.assign(verdict=verdict, certified=certified, excess=excess.clip(lower=0.0))


def count(judged: pd.DataFrame, methods: list[str]) -> pd.DataFrame:
    """Runs per method (rows) and verdict, with how many of them rest on a certified optimum."""
    counts = pd.crosstab(judged["method"], judged["verdict"])
    counts = counts.reindex(index=methods, columns=list(VERDICTS), fill_value=0)
    counts["posed"] = judged.groupby("method").size().reindex(methods, fill_value=0)
    certified = judged.groupby("method")["certified"].sum()
    counts["certified"] = certified.reindex(methods, fill_value=0).astype(int)
    return counts


def build(tables: Tables, styles: dict[str, Style], judged: pd.DataFrame) -> Figure:
    """RMSE against objective regret, one point per run: search errors right, model errors left."""
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
            regret = (part["excess"] / part["n_inliers"]).clip(lower=1e-8)
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
