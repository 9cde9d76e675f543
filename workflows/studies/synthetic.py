"""Synthetic results of any number of runs, in the files that the stages write.

Values are random, with fixed seeds. Their shares are like those of real runs: methods that certify have
bounds and histories, others have neither; some methods are not installed, do not support a model, hit
limits, or fail. Methods, options and cards are real, and so is the plan.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from baselines import registry
from baselines.contract import Card
from dcreg.names import NORM_TRANSLATION, RIGID_POSE, SIMILARITY_POSE
from dcreg.status import Status
from workflows import hashing, records
from workflows.config import MethodSettings, load
from workflows.instances import Problem, write_problems
from workflows.metrics import METRICS
from workflows.stages.evaluate import relate
from workflows.stages.plan import Plan, expand, plan_table

NAME = "paper3d-100"  # the claims about paper3d are judged by these tables
RUNS_PER_TRIAL = 10_000  # 100 methods, 4 shapes, 25 levels
N_POINTS = 40
LIMIT_S = 100.0
LEVELS, SHARES = [0.01, 0.02, 0.03, 0.04, 0.05], [0.1, 0.2, 0.3, 0.4, 0.5]
CONFIG: dict[str, Any] = {
    "name": NAME,
    "title": "Synthetic runs",
    "limits": {"time_s": LIMIT_S},
    "datasets": [
        {
            "dataset": "embedded",
            "n_points": N_POINTS,
            "tests": {
                "deformation": LEVELS,
                "noise": LEVELS,
                "mixed_outliers": SHARES,
                "separate_outliers": SHARES,
                "occlusion_outliers": SHARES,
            },
        }
    ],
    "methods": [
        *("dcreg_3d", "points_3d", "pairs", "pairs_3d"),
        *({"name": name, "baseline": name} for name in ("rpm_pa", "rpm_cav", "rpm_bp")),
        *(
            {"name": f"{name}-half", "baseline": name, "n_inliers_ratio": 0.5}
            for name in ("rpm_pa", "rpm_cav", "rpm_bp")
        ),
        {"name": "rpm_bp-ours", "baseline": "rpm_bp", "options": {"search": "ours"}},
        {"name": "hbsp-ours", "baseline": "hbsp", "options": {"search": "ours"}},
        {"name": "rpm_pa-exact", "baseline": "rpm_pa", "options": {"epsilon0": 0.1}},
        {"name": "rpm_pa-coarse", "baseline": "rpm_pa", "options": {"epsilon0": 0.3}},
        {"name": "rpm_cav-ascents", "baseline": "rpm_cav", "options": {"ascents": 1}},
        {"name": "rpm_cav-two-ascents", "baseline": "rpm_cav", "options": {"ascents": 2}},
    ],
    "vary": {"front_end": ["norm-signature", "fpfh-mutual", "oracle"]},
}
NOT_INSTALLED = ("dcp", "dgr", "hunter", "pygcransac", "pysuperansac")
# How runs end, with its share: of methods without and with bounds.
ENDS = {
    False: {Status.CONVERGED: 0.975, Status.TIME_LIMIT: 0.02, Status.FAILED: 0.005},
    True: {
        Status.OPTIMAL: 0.55,
        Status.TIME_LIMIT: 0.36,
        Status.ASSIGNMENT_LIMIT: 0.05,
        Status.NODE_LIMIT: 0.02,
        Status.MEMORY_LIMIT: 0.01,
        Status.FAILED: 0.01,
    },
}
MEAN_EVENTS, MOST_EVENTS = 40, 500  # of the history of a run with bounds


def write(out: Path, n_trials: int, events: int = MEAN_EVENTS) -> tuple[Path, Path]:
    """Write config and results of ``n_trials * RUNS_PER_TRIAL`` runs.

    Parameters
    ----------
    out : Path
        Gets ``paper3d-100.yaml`` and ``results/paper3d-100`` with instances, runs, plan and metrics.
    n_trials : int
        Trials of each level.
    events : int
        Mean length of a bound history.

    Returns
    -------
    config, folder : Path
        The config, and the folder of results.
    """
    folder = out / "results" / NAME
    folder.mkdir(parents=True)
    config = out / f"{NAME}.yaml"
    entry = {**CONFIG["datasets"][0], "trials": n_trials}
    config.write_text(yaml.safe_dump({**CONFIG, "datasets": [entry]}), encoding="utf-8")
    plan = expand(load(str(config)), None, str(config))
    planned = plan_table(plan)
    records.write(planned, folder / "plan" / "plan.parquet")
    facts = _instances(plan, folder)
    metrics = []
    for method in plan.methods:
        rows = planned[planned["method"] == method.name].merge(facts, on="instance_id")
        runs, judged, history = _runs(method, rows, events)
        _write_jobs(folder / "runs" / method.name, rows["chunk_id"], runs, history)
        metrics.append(judged)
    records.write(
        relate(pd.concat(metrics, ignore_index=True)), folder / "metrics" / "metrics.parquet"
    )
    return config, folder


def _instances(plan: Plan, folder: Path) -> pd.DataFrame:
    """Write random clouds for all chunks; return the facts about each instance."""
    rng, rows = np.random.default_rng(0), []
    for chunk in plan.chunks:
        dim = 2 if chunk.model == "similarity2d" else 3
        problems = [
            Problem(
                spec.instance_id, spec.model, rng.random((N_POINTS, dim)), rng.random((N_POINTS, dim)),
                (0.5, 1.5), N_POINTS, 0.1,
            )
            for spec in chunk.instances
        ]  # fmt: skip
        write_problems(folder / "instances" / f"{chunk.name}.npz", problems)
        for spec in chunk.instances:
            floor = 0.002 + 0.5 * spec.level * rng.uniform(0.9, 1.1)
            rows.append(
                {
                    "instance_id": spec.instance_id, "dim": dim, "rmse_floor": floor,
                    "noise_bound": max(0.01, 2 * floor), "n_inliers_true": N_POINTS,
                    "objective_true": N_POINTS * floor**2 * rng.uniform(0.9, 1.0),
                    "T_reference": json.dumps(_poses(rng, 1, dim)[0].tolist()),
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def _poses(rng: np.random.Generator, count: int, dim: int) -> np.ndarray:
    poses = np.tile(np.eye(dim + 1), (count, 1, 1))
    poses[:, :dim] += 0.3 * rng.standard_normal((count, dim, dim + 1))
    return poses


def _runs(
    method: MethodSettings, rows: pd.DataFrame, events: int
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Return raw results, metrics and bound histories of a method, for rows of the plan with facts."""
    card = registry.read_card(method.baseline)
    rng = np.random.default_rng(hashing.seed(method.name))
    count = len(rows)
    bounds = card.provides_bounds
    ends = ENDS[bounds]
    names = np.array([end.value for end in ends], dtype=object)
    status = rng.choice(names, count, p=list(ends.values()))
    if method.baseline in NOT_INSTALLED:
        status[:] = Status.UNAVAILABLE.value
    status[~rows["model"].isin(card.models).to_numpy()] = Status.UNSUPPORTED.value
    posed = np.isin(status, [end.value for end in ends if end is not Status.FAILED])
    n_inliers = max(1, round(method.n_inliers_ratio * N_POINTS))
    truth = rows["objective_true"].to_numpy() * n_inliers / N_POINTS
    wrong = rng.random(count) < 0.05 + 8 * rows["level"].to_numpy() / (1 + rows["level"]) / 10
    objective = truth * np.where(
        wrong, rng.uniform(1.0, 4.0, count), rng.uniform(0.95, 1.02, count)
    )
    judged = _metrics(rng, rows, card, posed, wrong)
    judged = judged.assign(
        n_inliers=n_inliers, objective=np.where(posed, objective, np.nan), objective_true=truth
    )
    work = rng.lognormal(7.0, 1.5, count).round()
    is_optimal = status == Status.OPTIMAL.value
    proven = np.where(is_optimal, 1 - 0.01 * rng.random(count), rng.random(count) ** 2)
    upper = np.where(posed & bounds, objective * rng.uniform(1.0, 1.001, count), np.nan)
    lower = upper * np.where(is_optimal, proven, 0.95 * proven)
    late = status == Status.TIME_LIMIT.value
    seconds = np.where(late, LIMIT_S, np.minimum(work * (3e-3 if bounds else 2e-5), 0.9 * LIMIT_S))
    poses = {dim: _poses(rng, count, dim) for dim in rows["dim"].unique()}
    raw = {
        "run_id": rows["run_id"], "instance_id": rows["instance_id"],
        "instance_digest": [f"{value:012x}" for value in rng.integers(0, 2**48, count)],
        "n_source": N_POINTS, "n_target": N_POINTS, "n_inliers": n_inliers,
        "seed": rng.integers(0, 2**32, count), "status": status,
        "message": _messages(status, work, card),
        "T_target_source": [
            json.dumps(poses[dim][at].tolist()) if posed[at] else ""
            for at, dim in enumerate(rows["dim"])
        ],
        "lower_bound": lower, "upper_bound": upper, "gap": upper - lower,
        "gap_tol": 0.01 * upper, "bound_ratio": lower / upper,
        "certificate_scope": np.where(np.isnan(upper), "", [_scope(card, m) for m in rows["model"]]),
        "n_nodes": np.where(posed & bounds, work, np.nan),
        "n_assignments": np.where(posed & card.solves_assignments, 4 * work, np.nan),
        "time_solve_s": np.where(posed, seconds, np.nan), "time_warmup_s": 1.5,
        "time_overhead_s": np.where(posed, rng.uniform(0.001, 0.003, count), np.nan),
        "peak_memory_mb": np.where(posed, rng.uniform(200, 400, count).round(1), np.nan),
        "fingerprint": "1", "machine_id": "00000000", "parallel_jobs": 2.0,
        "extra": [f'{{"time_s_translation": {value:.6g}}}' for value in 0.5 * seconds]
        if method.baseline == "dcreg_paper" else "{}",
    }  # fmt: skip
    runs = records.conform(pd.DataFrame(raw, index=rows.index), records.RAW, method.name)
    return runs, judged, _histories(rng, runs, rows["dim"], events)


def _metrics(
    rng: np.random.Generator, rows: pd.DataFrame, card: Card, posed: np.ndarray, wrong: np.ndarray
) -> pd.DataFrame:
    """Return the columns of `evaluate.evaluate`, without objectives."""
    count = len(rows)
    excess = np.where(
        wrong, rng.lognormal(-1.5, 0.5, count), 0.3 * rows["rmse_floor"] * rng.random(count)
    )
    rmse = np.hypot(rows["rmse_floor"], excess)
    table = rows[["run_id", "instance_id", "n_inliers_true", "dim", "noise_bound", "T_reference"]]
    found: dict[str, Any] = {
        "rmse": rmse, "rmse_excess": excess, "rmse_over_scale": rmse / 1.1,
        "rotation_error_deg": np.where(wrong, rng.uniform(5, 180, count), 2 * rng.random(count)),
        "translation_error": rmse * rng.random(count), "scale_error": 0.01 * rng.random(count),
        "bound_violation": 0.0 if card.provides_bounds else np.nan,
        "norm_translation_error": np.where(rows["dim"] == 3, rmse * rng.random(count), np.nan),
    }  # fmt: skip
    found = {name: np.where(posed, values, np.nan) for name, values in found.items()}
    found |= {
        "rmse_true": rows["rmse_floor"], "rmse_floor": rows["rmse_floor"],
        "success": posed & (excess < 0.05), "admissible": posed, "truth_in_cube": np.nan,
    }  # fmt: skip
    absent = (
        set(METRICS)
        - set(found)
        - {"objective", "objective_true", "objective_best", "objective_regret"}
    )
    return table.assign(**found, **dict.fromkeys(sorted(absent), np.nan))


def _messages(status: np.ndarray, work: np.ndarray, card: Card) -> list[str]:
    texts = {
        Status.UNAVAILABLE: f"{card.requires or card.display_name} is not installed",
        Status.UNSUPPORTED: f"{card.display_name} does not support this model",
        Status.FAILED: "the worker was killed: signal 9",
    }
    return [
        texts.get(Status(end), f"boxes {count:.0f}" if card.provides_bounds else "")
        for end, count in zip(status, work, strict=True)
    ]


def _scope(card: Card, model: str) -> str:
    if "nearest-neighbour" in card.certifies or "number of matched" in card.certifies:
        return card.certifies
    if model == "similarity2d":
        return SIMILARITY_POSE
    return RIGID_POSE if "mode full" in card.certifies else NORM_TRANSLATION


def _histories(
    rng: np.random.Generator, runs: pd.DataFrame, dim: pd.Series, events: int
) -> pd.DataFrame:
    """Return histories of random length; searches in 3D have two stages."""
    known = runs[runs["upper_bound"].notna()]
    lengths = np.minimum(rng.geometric(1 / max(1, events - 1), len(known)) + 1, MOST_EVENTS)
    last = np.cumsum(lengths) - 1
    which = np.repeat(np.arange(len(known)), lengths)
    step = np.arange(len(which)) - (last - lengths + 1)[which]
    done = (step + 1) / lengths[which]
    own = known.iloc[which].reset_index(drop=True)
    in_second = (done > 0.8) & (dim.loc[known.index].to_numpy()[which] == 3)
    history = {
        "run_id": own["run_id"], "instance_id": own["instance_id"],
        "stage": np.where(in_second, "rotation", "search"),
        "kind": np.where(done == 1, "end", "bound"), "time_s": own["time_solve_s"] * done,
        "n_nodes": (own["n_nodes"] * done).round(),
        "n_assignments": (own["n_assignments"] * done).round(),
        "n_open": (100 * (1 - done)).round(), "lower_bound": own["lower_bound"] * np.sqrt(done),
        "upper_bound": own["upper_bound"] * (1 + 2 * (1 - done) ** 3),
    }  # fmt: skip
    return records.conform(pd.DataFrame(history), records.RAW_TRACES, "synthetic")


def _write_jobs(folder: Path, chunks: pd.Series, runs: pd.DataFrame, history: pd.DataFrame) -> None:
    """Write the two files of every solve job of a method."""
    chunk_of: Mapping[str, str] = dict(zip(runs["run_id"], chunks, strict=True))
    events = {str(name): part for name, part in history.groupby(history["run_id"].map(chunk_of))}
    none = history.iloc[:0]
    for chunk, part in runs.groupby(chunks.to_numpy(), sort=False):
        records.write(part, folder / f"{chunk}.parquet")
        records.write(events.get(str(chunk), none), folder / f"{chunk}.trace.parquet")
