"""The kinds of checks over the study of bounds (`workflows.studies.bounds`)."""

from __future__ import annotations

import numpy as np
import pandas as pd

from reports.ledger import intervals
from reports.ledger.finding import Finding, Parameters, Source, check
from workflows.studies import N_FITTED, SHOWING

BOX = ["instance", "trial"]  # identify a box up to its width


@check("boxes", of_study=True)
def boxes(source: Source, p: Parameters) -> Finding:
    """Share of the boxes in which one bound is at least another one; a comparison per width."""
    finding = Finding("share of boxes")
    table = source.evidence.study["boxes"].dropna(subset="value")
    wide = table.pivot_table(index=[*BOX, "width"], columns="bound", values="value")
    wide = wide.reset_index()
    if pattern := p.get("instances"):
        wide = wide[wide["instance"].str.startswith(pattern)]
    for rival in p["rivals"]:
        if not {p["subject"], rival} <= set(wide.columns):
            finding.miss(f"bound {rival}")
            continue
        both = wide.dropna(subset=[p["subject"], rival])
        finding.rows.append(both)
        above = both[p["subject"]] >= both[rival] - 1e-9 * (1 + both[rival].abs())
        for width, part in above.groupby(both["width"]):
            found = intervals.share(part.to_numpy(dtype=float))
            finding.add((p["subject"], rival), ("boxes", f"width {width:.2g}"), found, p["claimed"])
    return finding


@check("orders", of_study=True)
def orders(source: Source, p: Parameters) -> Finding:
    """Mean slope of log loss over log box width, over boxes that contain the optimum."""
    finding = Finding("slope of log loss over log width")
    table = source.evidence.study["boxes"]
    table = table[table["place"] != "away"].assign(loss=table["minimum"] - table["value"])
    table = table[table["loss"] > SHOWING * table["minimum"]]
    for name, claimed in p["bounds"].items():
        slopes = [
            _slope(part.nsmallest(N_FITTED, "width"))
            for _, part in table[table["bound"] == name].groupby(BOX, sort=False)
            if len(part) > 2
        ]
        if slopes:
            finding.rows.append(table[table["bound"] == name])
            finding.add((name, ""), ("boxes", ""), intervals.mean(np.array(slopes)), claimed)
        else:
            finding.miss(f"bound {name}")
    return finding


def _slope(part: pd.DataFrame) -> float:
    return float(np.polyfit(np.log(part["width"]), np.log(part["loss"]), 1)[0])


@check("work", of_study=True)
def work(source: Source, p: Parameters) -> Finding:
    """Ratio of gaps after the number of assignments that both searches of an instance solved."""
    finding = Finding("ratio of mean gap at equal assignments")
    table = source.evidence.study["searches"]
    finding.rows.append(table[table["bound"].isin([p["subject"], *p["rivals"]])])
    for rival in p["rivals"]:
        gaps = []
        for _, part in table.groupby(["instance", "trial"], sort=False):
            mine, theirs = (part[part["bound"] == name] for name in (p["subject"], rival))
            if len(mine) and len(theirs):
                shared = min(mine["n_assignments"].max(), theirs["n_assignments"].max())
                gaps.append([h.loc[h["n_assignments"] <= shared, "gap"].iloc[-1]
                             if (h["n_assignments"] <= shared).any() else h["gap"].iloc[0]
                             for h in (mine, theirs)])  # fmt: skip
        if gaps:
            found = intervals.ratio(*np.array(gaps).T)
            finding.add((p["subject"], rival), ("searches", ""), found, p["claimed"])
        else:
            finding.miss(f"bound {rival}")
    return finding
