"""The first screen: the experiment, its claims of the paper, and a row per method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from reports.ledger.evidence import STUDY, Evidence
from reports.ledger.judging import count, judge, ledger
from reports.page import Page
from reports.pairs import pair_rows
from reports.standing import BEST, FEW, TIED, WORSE, Matrix, matrices
from reports.tables import PENALTY, Tables, counted_time, is_refuted, is_right, share_interval
from reports.theme import Style, integer, listed, share, words
from workflows.compose import QUICK
from workflows.metrics.errors import SUCCESS_SHARE
from workflows.outcomes import (
    OUTCOMES,
    STARTED,
    attempted,
    comparable_times,
    is_timed,
    main_machine,
)
from workflows.stages.evaluate import success_limits

ID = "outcome"
TITLE = "Outcome"
POSITION = 10
MAX_NAMED = 4
LIMITS = {
    "rmse": "RMSE < {:g}",
    "rotation_error_deg": "rotation error < {:g}°",
    "translation_error": "translation error < {:g}",
}
MOST_ROWS = 60  # of the table per pair; longer ones open with the first pair
AMONG = "among the methods that are compared, "
NEEDED = [
    "model", "method", "status", "outcome", "success", "gap", "bound_ratio", "certificate_scope",
    "rmse_excess", "rmse_floor", "n_assignments", "truth_in_cube",
]  # fmt: skip


def context(page: Page) -> dict[str, Any]:
    tables = page.tables
    evidence = Evidence.of_tables(tables)
    about = set(evidence.experiments) | ({STUDY} if evidence.study else set())
    judgements = judge(ledger(), evidence, about)
    rows, found = outcomes(tables), matrices(tables)
    pairs = pair_rows(tables)
    return {
        "what": what(tables),
        "facts": facts(tables),
        "pairs": pairs,
        "pair_names": list(dict.fromkeys(row["shape"] for row in pairs)),
        "most_rows": MOST_ROWS,
        "judgements": judgements,
        "counts": count(judgements),
        "claims": len(ledger().claims),
        "matrices": found,
        "is_compared": any(matrix.is_compared for matrix in found),
        "sentences": []
        if tables.is_of_blocks
        else [sentence(matrix, page.styles) for matrix in found],
        "is_of_blocks": tables.is_of_blocks,
        "outcomes": rows,
        "models": list(dict.fromkeys(row["model"] for row in rows)),
        "unfinished": sum(row["unfinished"] for row in rows),
        "is_quick": tables.experiment.endswith(QUICK),
        "any_oracle": any(tables.is_oracle(method) for method in tables.methods),
        "penalty": PENALTY,
        "wrong_certificates": list(tables.runs.loc[is_refuted(tables.runs), "run_id"]),
    }


def sentence(matrix: Matrix, styles: dict[str, Style]) -> str:
    """Return which methods are best on all tests together, and what is known of the others."""
    first = matrix.columns[0]
    if len(matrix.rows) == 1:
        ((label, cells),) = matrix.rows.items()
        rate = share(cells[first].share, *cells[first].interval)
        return (
            f"{matrix.model}: {styles[label].name} finds the right pose in {rate} of "
            f"{cells[first].runs} runs; no other method was attempted."
        )
    best, tied, few, worse = (
        [styles[name].name for name in matrix.standing(kind)] for kind in (BEST, TIED, FEW, WORSE)
    )
    if not best:
        return (
            f"{matrix.model}: no two methods are compared, because the others receive the true pairs "
            "or attempted fewer than half of the instances."
        )
    cell = matrix.rows[matrix.standing(BEST)[0]][first]
    among = "" if all(cells[first].standing for cells in matrix.rows.values()) else AMONG
    verb = "has" if len(best) == 1 else "have"
    compared = [cells[first] for cells in matrix.rows.values() if cells[first].standing]
    some = " of those with the most runs" * any(each.runs < cell.runs for each in compared)
    found = (
        f"{matrix.model}: {among}{listed(best)} {verb} the highest success rate{some}, "
        f"{share(cell.share, *cell.interval)} of {cell.runs} runs"
    )
    if tied:
        found += f"; {listed(tied)} {'is' if len(tied) == 1 else 'are'} not significantly worse"
    if few:
        found += f"; there are too few instances to say whether {listed(few)} "
        found += f"{'is' if len(few) == 1 else 'are'} worse"
    return found + ("; the others are significantly worse." if worse and not tied + few else ".")


def what(tables: Tables) -> str:
    """Return what was attempted, in one sentence, and in a second one which runs are not planned."""
    runs = tables.runs
    tried = attempted(runs)
    tests = runs["test"].nunique()
    dims = " and ".join(f"{dim}D" for dim in sorted(runs["dim"].unique()))
    planned, started = runs["method"].nunique(), tried["method"].nunique()
    counts = runs["outcome"].value_counts()
    left = [
        f"{integer(counts[name])} {words(name)}"
        for name in OUTCOMES
        if name in counts and name not in STARTED
    ]
    return (
        f"{_of(started, planned)} method{'s' * (planned > 1)} {'was' if started == 1 else 'were'} "
        f"attempted on "
        f"{_of(tried['instance_id'].nunique(), runs['instance_id'].nunique())} instances of "
        f"{listed(list(runs['dataset'].unique()))}, {tests} test{'s' * (tests > 1)} in {dims}: "
        f"{'all ' * (len(tried) == len(runs))}{_of(len(tried), len(runs))} planned runs were attempted"
        + "".join(f", {text}" for text in left)
        + f".{_not_planned(runs)}"
    )


def _of(count: int, total: int) -> str:
    return integer(total) if count == total else f"{integer(count)} of {integer(total)}"


def _not_planned(runs: pd.DataFrame) -> str:
    """Return on how many instances a method is planned, if that differs: some have only one model."""
    per_method = runs.groupby("method")["instance_id"].nunique()
    low, high, total = per_method.min(), per_method.max(), runs["instance_id"].nunique()
    if low == total:
        return ""
    each = f"{low}" if low == high else f"{low} to {high}"
    return (
        f" Not every method is planned for every instance: each is planned for {each} of {total}."
    )


def facts(tables: Tables) -> list[tuple[str, str]]:
    """Return data, points, limit, threshold, prior and machine of the experiment, in a few words each."""
    runs, data, points = tables.runs, [], []
    shown = runs[["dataset", "model", "shape", "test", "instance_id", "n_source", "n_target"]]
    for (dataset, model), part in shown.groupby(["dataset", "model"], sort=False):
        tests = part["test"].nunique()
        grid = f"{tests} test{'s' * (tests > 1)}, {part['instance_id'].nunique()} instances"
        data.append(f"{_named(part['shape'].unique(), str(dataset))} ({model}; {grid})")
        both = part[["n_source", "n_target"]].to_numpy()
        points.append(f"{both.min()}" + (f" to {both.max()}" if both.max() > both.min() else ""))
    return [
        ("data", "; ".join(data)),
        ("points per cloud", "; ".join(dict.fromkeys(points))),
        ("limit", _limit(tables)),
        ("success", success_rule(runs)),
        ("n_inliers (n_p)", _prior(runs)),
        ("machine", _machine(tables)),
    ]


def _machine(tables: Tables) -> str:
    """Return the machine that all times refer to; runs whose times are not used are counted."""
    card, main = tables.provenance.get("machine", {}), main_machine(tables.runs)
    text = f"{card.get('cpu', 'unknown')}, {card.get('cores', '?')} cores"
    if main not in (card.get("machine_id", main), ""):
        text = f"machine {main}"
    left_out = attempted(tables.runs[~is_timed(tables.runs)])
    elsewhere = left_out.loc[left_out["machine_id"] != main, "machine_id"]
    if count := len(elsewhere):
        others = elsewhere.nunique()
        text += f"; the times of {count} runs on {others} other machine{'s' * (others > 1)} are not used"
    if count := len(left_out) - len(elsewhere):
        text += f"; the times of {count} runs with another number of parallel jobs are not used"
    return text


def _prior(runs: pd.DataFrame) -> str:
    ratios = sorted(runs["n_inliers_ratio"].unique(), reverse=True)
    full = runs.loc[runs["n_inliers_ratio"] == 1.0]
    # methods that receive fewer points also receive a proportionally smaller number of pairs
    is_whole = full["n_source"] == full.groupby("instance_id")["n_source"].transform("max")
    differs = is_whole & (full["n_inliers"] != full["n_inliers_true"])
    tests = full.loc[differs, "test"].unique()
    other = (
        f" (in {', '.join(tests)}: × the pairs that the dataset prescribes)" if len(tests) else ""
    )
    fewer = "" if is_whole.all() else "; in proportion for methods that receive fewer points"
    return " and ".join(f"{ratio:g}" for ratio in ratios) + " × the true pairs" + other + fewer


def _named(names: np.ndarray, dataset: str) -> str:
    if list(names) == [dataset]:
        return dataset
    # one more name is as short as "and 1 more"
    few = [*map(str, names if len(names) <= MAX_NAMED + 1 else names[:MAX_NAMED])]
    more = f" and {len(names) - len(few)} more" if len(names) > len(few) else ""
    return ", ".join(few) + more + f" of {dataset}"


def _limit(tables: Tables) -> str:
    """Return the limits in words."""
    limits = [card.get("limits", {}) for card in tables.cards.values()]
    by_work = [each for each in limits if each.get("nodes") or each.get("assignments")]
    known = sorted({each["time_s"] for each in limits if each.get("time_s")})
    texts = [_range(known, " s per run")] if known else []
    for key, unit in (("assignments", "assignments"), ("nodes", "boxes")):
        counts = [each[key] for each in by_work if each.get(key)]
        if counts:
            numbers = _range(sorted(set(counts)), f" {unit}")
            texts.append(f"{numbers} per search for {len(counts)} of {len(limits)} methods")
    return "; ".join(texts) or "not stated"


def _range(values: list[float], unit: str) -> str:
    shown = f"{values[0]:g}" + (f" to {values[-1]:g}" if len(values) > 1 else "")
    return shown + unit


def success_rule(runs: pd.DataFrame) -> str:
    """Return in words when a pose counts as right."""
    names = runs["dataset"].unique()
    stated = {name: limits for name in names if (limits := success_limits(name))}
    texts = [
        f"{' and '.join(LIMITS[key].format(limit) for key, limit in limits.items())} ({name})"
        for name, limits in stated.items()
    ]
    if len(stated) < len(names):
        texts.append(f"error above the floor < {SUCCESS_SHARE:g} of the longest side")
    return "; ".join(texts)


def outcomes(tables: Tables) -> list[dict[str, Any]]:
    """Return shares over attempted runs per model and method; a run without a pose is no success.

    Rows are sorted by success rate; methods that receive the true pairs come last.
    """
    here = is_timed(tables.runs)
    runs = attempted(
        tables.runs[NEEDED].assign(
            time=counted_time(tables.runs, tables.cards).where(here),
            time_solve_s=comparable_times(tables.runs),
        )
    )
    rows = []
    for (model, method), part in runs.groupby(["model", "method"], sort=False):
        language = tables.cards.get(str(method), {}).get("language", "")
        rows.append({"model": model, "method": method, "language": language, **_outcome(part)})
    models, methods = list(runs["model"].unique()), tables.methods

    def rank(row: dict[str, Any]) -> tuple[int, bool, float, int]:
        is_oracle = tables.is_oracle(row["method"])
        place = methods.index(row["method"])
        return models.index(row["model"]), is_oracle, -row["success"], place

    return sorted(rows, key=rank)


def _outcome(part: pd.DataFrame) -> dict[str, Any]:
    bounding, right = bool(part["gap"].notna().any()), is_right(part)
    return {
        "runs": len(part),
        "success": float(right.mean()),
        "interval": share_interval(int(right.sum()), len(part)),
        "certified": float(part["status"].eq("optimal").mean()) if bounding else None,
        "bound_ratio": float(part["bound_ratio"].median()) if bounding else None,
        "scopes": ", ".join(filter(None, part["certificate_scope"].unique())),
        "excess": float(part["rmse_excess"].fillna(np.inf).median()),
        "floor": float(part["rmse_floor"].median()),
        "time": float(part["time"].mean()),
        "median_time": float(part["time_solve_s"].median()),
        "assignments": float(part["n_assignments"].median()),
        "truth_excluded": float(1 - part["truth_in_cube"].mean()),  # NaN without such a cube
        "limited": int(part["outcome"].eq("limited").sum()),
        "unfinished": bool(part["outcome"].eq("limited").mean() > 0.5),
        "failed": int(part["outcome"].eq("failed").sum()),
    }
