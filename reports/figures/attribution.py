"""Search errors and model errors, by the objective regret per method."""

from __future__ import annotations

import pandas as pd

from reports.figures.figure import Figure
from reports.figures.grid import Grid, Panel
from reports.theme import Style, words
from workflows.attribution import VERDICTS, tolerance

MAX_POINTS = 10_000  # of the figure
_NEEDED = [
    "run_id", "instance_id", "model", "method", "test", "level", "status", "verdict", "n_inliers", "rmse",
    "objective", "objective_true", "objective_best", "objective_regret", "optimum_at_least",
    "regret_at_most", "gap_tol", "certificate_scope",
]  # fmt: skip


def judged(runs: pd.DataFrame) -> pd.DataFrame:
    """Return what `count` and `build` need; ``proven``: the pose is optimal within the tolerance."""
    part = runs[_NEEDED]
    return part.assign(proven=part["regret_at_most"] <= tolerance(part))


def count_by_test(runs: pd.DataFrame, methods: list[str]) -> list[tuple[str, str, pd.DataFrame]]:
    """Return model, test and the counts of each."""
    return [
        (str(model), str(test), count(part, methods))
        for (model, test), part in runs.groupby(["model", "test"], sort=False)
    ]


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
    counts["proven"] = by_method["proven"].sum().reindex(methods, fill_value=0).astype(int)
    for end in ("objective_regret", "regret_at_most"):
        per_pair = (known[end].clip(lower=0) / known["n_inliers"]) ** 0.5
        counts[end] = per_pair.groupby(known["method"]).median().reindex(methods)
    return counts


def drawn_share(runs: pd.DataFrame) -> int:
    """Return n if every n-th run is drawn: a page cannot show more than `MAX_POINTS`."""
    return max(1, -(-int(runs["objective_regret"].notna().sum()) // MAX_POINTS))


def build(runs: pd.DataFrame, styles: dict[str, Style]) -> Figure:
    """Draw RMSE against objective regret, a point per run: search errors right, model errors left."""
    drawn = runs[runs["objective_regret"].notna()].iloc[:: drawn_share(runs)]
    grid, traces = Grid(column_titles=list(dict.fromkeys(drawn["model"]))), []
    for column, model in enumerate(grid.column_titles):
        panel = Panel(
            0, column, "E(found) − E(best known), per pair", "RMSE", "log", "log", share_y=False
        )
        axes = grid.add(panel)
        for method, style in styles.items():
            part = drawn[(drawn["model"] == model) & (drawn["method"] == method)]
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
                    "text": text, "customdata": list(part["run_id"]),
                    "hovertemplate": "%{text}<br>RMSE %{y:.3g}<extra></extra>",
                    "marker": {"symbol": style.symbol, "size": 7, "opacity": 0.75},
                    "meta": {"role": "runs", "method": method},
                }
            )  # fmt: skip
    payload = {"views": {"": {"data": traces, "layouts": grid.layouts()}}, "scales": {}}
    return Figure("attribution", "RMSE against objective regret", "plain", payload)
