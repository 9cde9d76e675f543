"""Primal, dual and gap integrals: how fast a search closes its gap, in one number per run.

Three relative gaps are integrated over seconds and over boxes until the run ends: from the reference to
the upper bound (primal), from the lower bound to the reference (dual), and from the lower to the upper
bound (gap). Each is between 0 (closed) and 1 (no bound). The reference is the minimum upper bound of all
runs with the same instance, number of pairs and certificate scope.
See T. Berthold, Measuring the impact of primal heuristics, Oper. Res. Lett. 41 (2013).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from workflows.records import Column

if TYPE_CHECKING:
    import pandas as pd

AXES = {"s": "time_s", "boxes": "n_nodes"}
KINDS = ("primal", "dual", "gap")
COLUMNS = {
    f"{kind}_integral_{axis}": Column(
        float, f"integral of the {kind} gap (0 to 1) over {axis} until the end of the run"
    )
    for axis in AXES
    for kind in KINDS
}
_START = "start"  # stage of the first incumbents, with the same objective as the search


def integrals(runs: pd.DataFrame, traces: pd.DataFrame) -> pd.DataFrame:
    """Return a table with `COLUMNS` and the index of `runs`; empty for runs without bounds."""
    import pandas as pd

    same = ["instance_id", "n_inliers", "certificate_scope"]
    best = runs.groupby(same)["upper_bound"].transform("min")
    references = dict(zip(runs["run_id"], best, strict=True))
    rows = {
        run_id: _integrals_of(events, references[run_id])
        for run_id, events in traces.groupby("run_id", sort=False)
        if run_id in references
    }
    found = pd.DataFrame.from_dict(rows, orient="index", columns=list(COLUMNS), dtype=float)
    return found.reindex(runs["run_id"]).set_index(runs.index)


def _integrals_of(events: pd.DataFrame, reference: float) -> list[float]:
    """Integrate over the stage with most boxes and the stage that found its first incumbents."""
    stage = events["stage"].iloc[events["n_nodes"].to_numpy().argmax()]
    events = events[events["stage"].isin((_START, stage))]
    lower = events["lower_bound"].fillna(0.0).to_numpy()
    upper = events["upper_bound"].fillna(np.inf).to_numpy()
    gaps = [_gap(upper, reference), _gap(reference, lower), _gap(upper, lower)]
    return [
        integral(events[column].to_numpy(dtype=float), gap)
        for column in AXES.values()
        for gap in gaps
    ]


def _gap(above: np.ndarray | float, below: np.ndarray | float) -> np.ndarray:
    """Return ``(above - below) / above`` within [0, 1]; 1 if `above` is infinite."""
    above, below = np.broadcast_arrays(np.asarray(above, float), np.asarray(below, float))
    positive = (above > 0) & np.isfinite(above)
    gap = np.where(np.isfinite(above), 0.0, 1.0)
    gap[positive] = 1 - below[positive] / above[positive]
    return np.clip(gap, 0.0, 1.0)


def integral(at: np.ndarray, gap: np.ndarray) -> float:
    """Integrate a step function from 0: 1 before the first place, then ``gap[i]`` from ``at[i]`` on."""
    edges = np.maximum.accumulate(np.r_[0.0, at])
    return float(np.sum(np.diff(edges) * np.r_[1.0, gap[:-1]]))
