"""Made-up tables in the harness's format, for the tests of the report only: no real results."""

from __future__ import annotations

import itertools
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from dcreg.search import proven_share
from workflows import attribution, outcomes, records
from workflows.integrity import SUMS
from workflows.stages.aggregate import accounting
from workflows.stages.clouds import CLOUDS

CARDS = {
    "dcreg-full": ("DC-Reg", "port", "similarity pose", "#0072b2", "o"),
    "dcreg-half": ("DC-Reg", "port", "similarity pose", "#0072b2", "o"),
    "bilinear": ("Term-wise BnB", "reconstruction", "similarity pose", "#d55e00", "s"),
    "icp": ("ICP", "library", "nothing", "#e8d44d", "^"),
    "fgr": ("FGR", "library", "nothing", "#009e73", "D"),
    "teaser": ("TEASER++", "official", "nothing", "#7f3c8d", "P"),
}
BASELINES = {"dcreg-full": "dcreg", "dcreg-half": "dcreg", "bilinear": "rpm_htb"}
BOUNDING = ("dcreg-full", "dcreg-half", "bilinear")
CASES = [
    ("similarity2d", "demo", "fish-like", "deformation"),
    ("similarity2d", "demo", "glyph-like", "deformation"),
    ("similarity2d", "demo", "fish-like", "noise"),
    ("similarity2d", "demo", "glyph-like", "noise"),
    ("similarity2d", "demo", "fish-like", "mixed_outliers"),
    ("rigid3d", "demo", "horse-like", "noise"),
    ("rigid3d", "demo", "horse-like", "mixed_outliers"),
]
LEVELS = (0.0, 0.02, 0.04)
TRIALS = 3


def write_tables(folder: Path, experiment: str = "made-up", cases: Sequence[tuple] = CASES) -> Path:
    """Write runs, traces, accounting, provenance and overlays; returns `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    runs, traces = [], []
    for case, level, trial in itertools.product(cases, LEVELS, range(TRIALS)):
        for method in CARDS:
            run, events = _run(method, *case, level, trial)
            runs.append(run)
            traces += events
    table = pd.DataFrame(runs).assign(experiment=experiment)
    best = table.groupby(["instance_id", "n_inliers"])["objective"].transform("min")
    table["objective_best"] = best
    table["objective_regret"] = table["objective"] - best
    table["outcome"] = table["status"].map(outcomes.outcome)
    table = attribution.attribute(table)
    table = records.frame(table.to_dict("records"), records.runs_columns())
    records.write(table, folder / "runs.parquet", csv=True)
    records.write(records.frame(traces, records.TRACES), folder / "traces.parquet", csv=True)
    accounting(table).to_csv(folder / "accounting.csv", index=False)
    (folder / "provenance.json").write_text(json.dumps(_provenance()))
    (folder / "overlays.json").write_text(json.dumps(_overlays(table)))
    once = table.drop_duplicates("instance_id")
    clouds = [_clouds(run) for run in once.to_dict("records")]
    pd.DataFrame(clouds).to_parquet(folder / CLOUDS)
    (folder / SUMS).unlink()  # tests change the tables
    return folder


def _run(method, model, dataset, shape, test, level, trial):
    instance = f"{model}-{shape}-{test}-{level}-{trial}"
    draw = np.random.default_rng(zlib.crc32(f"{instance}{method}".encode()))
    status, message = _status(method, model, level, trial)
    posed = status in ("optimal", "converged", "time_limit")
    wrong = posed and (method in ("icp", "fgr") and draw.random() < 0.4)
    n_inliers = 49 if method == "dcreg-half" else 98
    truth = n_inliers * (0.01 + level) ** 2
    rmse = (0.01 + level) * (1 + 0.2 * draw.random()) + (0.3 if wrong else 0.0)
    objective = truth * (0.97 if not wrong else 3.0 + draw.random())
    tol = n_inliers * 0.01**2
    nodes = int(40 + 3000 * level * (4 if method == "bilinear" else 1) * (1 + draw.random()))
    seconds = nodes * 1e-3 if method in BOUNDING else 0.004 * (1 + draw.random())
    bounds = posed and method in BOUNDING
    left = tol * (0.9 if status == "optimal" else 6.0)
    number = float if posed else lambda _: float("nan")
    run = {
        "schema_version": records.SCHEMA_VERSION, "chunk_id": "c0", "instance_digest": instance,
        "run_id": f"{zlib.crc32(f'{instance}{method}'.encode()):08x}",
        "experiment": "made-up", "method": method, "baseline": method.split("-")[0],
        "display_name": CARDS[method][0], "provenance": CARDS[method][1], "options": "{}",
        "options_effective": json.dumps(dict.fromkeys(("bound", "mode", "front_end"))),
        "instance_id": instance, "dataset": dataset, "shape": shape, "test": test,
        "level": level, "trial": trial, "model": model, "dim": 3 if model == "rigid3d" else 2,
        "n_source": 98, "n_target": 98, "n_inliers": n_inliers, "n_inliers_true": 98, "seed": 1,
        "status": status, "message": message, "T_target_source": "",
        "lower_bound": objective - left if bounds else float("nan"),
        "upper_bound": objective if bounds else float("nan"),
        "gap": left if bounds else float("nan"),
        "bound_ratio": proven_share(objective - left, objective) if bounds else float("nan"),
        "gap_tol": tol if bounds else float("nan"),
        "certificate_scope": _scope(model) if bounds else "",
        "n_nodes": nodes if bounds else None, "n_assignments": 4 * nodes if bounds else None,
        "time_solve_s": number(seconds), "time_warmup_s": 0.5, "time_overhead_s": 0.002,
        "peak_memory_mb": 200.0, "fingerprint": "0", "machine_id": "m0",
        "rmse": number(rmse), "rmse_over_scale": number(rmse / (1.2 if model[0] == "s" else 1)),
        "rotation_error_deg": number(170 * draw.random() if wrong else 2 * draw.random()),
        "translation_error": number(rmse / 2),
        "scale_error": number(0.01 * draw.random() if model[0] == "s" else 0.0),
        "success": bool(posed and rmse < 0.1), "objective": number(objective),
        "objective_true": number(truth), "n_inliers_ratio": n_inliers / 98,
        "rmse_floor": number(0.009 + level), "rmse_true": number(0.01 + level),
        "rmse_excess": number((rmse**2 - (0.009 + level) ** 2) ** 0.5), "admissible": posed,
        "noise_bound": 2 * (0.009 + level), "T_reference": _identity(model),
        "bound_violation": 0.0 if bounds else float("nan"), "parallel_jobs": 1.0, "extra": "{}",
    }  # fmt: skip
    if posed:
        run["T_target_source"] = json.dumps(_overlay(run, "")["T_target_source"])
    return run, _events(run) if bounds else []


def _identity(model):
    return json.dumps(np.eye(4 if model == "rigid3d" else 3).tolist())


def _scope(model):
    return "similarity pose" if model == "similarity2d" else "translation in norm space"


def _status(method, model, level, trial):
    if method == "teaser":
        return "unavailable", "teaserpp_python is not installed; build it from its repository"
    if method == "fgr" and model == "similarity2d":
        return "unsupported", "FGR does not support similarity2d"
    if method == "fgr" and level == LEVELS[-1] and trial == 0:
        return "failed", "worker killed: signal 11 <b>segfault</b>"
    if method in BOUNDING:
        late = level == LEVELS[-1] and trial == 0
        return ("time_limit", "made-up bound") if late else ("optimal", "")
    return "converged", ""


def _events(run):
    events = []
    for stage in ("search", "rotation")[: run["dim"] - 1]:
        # a level without disturbance closes at the root: one event
        for i in range(25) if run["level"] else [24]:
            done = i / 24
            low = run["lower_bound"] * done**0.5
            high = run["upper_bound"] * (1 + 2 * (1 - done) ** 3)
            events.append(
                {
                    "run_id": run["run_id"], "method": run["method"],
                    "instance_id": run["instance_id"], "stage": stage,
                    "kind": "start" if i == 0 else "end" if i == 24 else "bound",
                    "time_s": run["time_solve_s"] * (0.001 + done),
                    "n_nodes": int(1 + run["n_nodes"] * done),
                    "n_assignments": int(4 + run["n_assignments"] * done),
                    "n_open": 3, "lower_bound": low, "upper_bound": high,
                }
            )  # fmt: skip
    return events


def _provenance():
    return {
        "config": {"name": "made-up", "methods": list(CARDS)},
        "machine": {"machine_id": "m0", "cpu": "made-up CPU", "cores": 2},
        "versions": {"numpy": "2.0", "dcreg": "0.1"},
        "git": {"commit": "0" * 40, "dirty": True},
        "created": "2026-01-01T00:00:00Z",
        "commands": ["python -m workflows run made-up"],
        "replay": "make replay RUN=",
        "methods": {
            label: {
                "display_name": name, "summary": "A made-up method.", "provenance": origin,
                "certifies": scope, "provides_bounds": label in BOUNDING,
                "citation": "Nobody, Nowhere, 2026", "licence": "MIT", "color": color,
                "marker": marker, "options": {"made_up_weight": 0.25, "threshold": "paper"},
                "unavailable": None, "limits": {"time_s": 10.0},
                "n_inliers_ratio": 0.5 if label == "dcreg-half" else 1.0,
                "baseline": BASELINES.get(label, label), "parameters": {"made_up_weight": 0.5},
                "deterministic": label != "fgr",
                "threshold_rule": {"text": "2 σ (nobody)", "origin": "paper", "confidence": 0.9},
            }
            for label, (name, origin, scope, color, marker) in CARDS.items()
        },
    }  # fmt: skip


def _overlays(runs):
    chosen = []
    posed = runs[runs["rmse"].notna()]
    for (_, _, _), group in posed.groupby(["method", "model", "test"]):
        ordered = group.sort_values("rmse")
        ranks = (("best", 0), ("median", len(ordered) // 2), ("worst", len(ordered) - 1))
        for rank, position in ranks:
            run = ordered.iloc[position]
            chosen.append(_overlay(run, rank))
    return chosen


def _clouds(run):
    overlay = _overlay(run | {"rmse": 0.0}, "")
    return {
        "instance_id": run["instance_id"],
        "dim": run["dim"],
        "source": np.ravel(overlay["source"]),
        "target": np.ravel(overlay["target"]),
        "pairs": np.repeat(np.arange(98), 2),
    }


def _overlay(run, rank):
    draw = np.random.default_rng(zlib.crc32(run["instance_id"].encode()))
    d, t = int(run["dim"]), np.linspace(0, 2 * np.pi, 98)
    curve = np.stack([np.cos(t), 0.5 * np.sin(2 * t), 0.3 * np.cos(3 * t)], axis=1)[:, :d]
    pose = np.eye(d + 1)
    angle = draw.uniform(0, 6)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:d, d] = 0.4
    target = curve @ pose[:d, :d].T + pose[:d, d] + run["level"] * draw.standard_normal((98, d))
    pose[0, d] += run["rmse"]
    fields = ("run_id", "method", "dataset", "shape", "test", "model", "status")
    return {
        **{name: run[name] for name in fields},
        "level": float(run["level"]), "trial": int(run["trial"]), "rank": rank,
        "rmse": float(run["rmse"]), "source": curve.round(4).tolist(),
        "target": target.round(4).tolist(), "T_target_source": pose.round(6).tolist(),
    }  # fmt: skip
