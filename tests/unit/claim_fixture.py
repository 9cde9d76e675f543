"""Made-up runs of a few methods, and shortcuts to judge them, for the tests of the ledger."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from reports.ledger.book import Claim, ledger
from reports.ledger.evidence import Evidence, Experiment
from reports.ledger.finding import CHECKS, Source
from reports.ledger.judging import judge_claim
from reports.tables import Tables
from tests.unit import claim_tables
from workflows import records

TRIALS = 30
LEVELS = (0.0, 0.1, 0.2)
PAPER = json.dumps(claim_tables.options_of(ledger().roles["dcreg_paper"]))
HTB = json.dumps(claim_tables.options_of(ledger().roles["rpm_htb"]))
PA = json.dumps(claim_tables.options_of(ledger().roles["rpm_pa"]))
# Method -> role, baseline, effective options and n_p.
METHODS = {
    "paper": ("dcreg_paper", "dcreg_paper", PAPER, 1.0),
    "half": ("dcreg_paper_half", "dcreg_paper", PAPER, 0.5),
    "ours": ("dcreg", "dcreg", '{"bound": null, "mode": null, "front_end": null}', 1.0),
    "rival": ("rpm_htb", "rpm_htb", HTB, 1.0),
    "pose": ("rpm_htb", "rpm_htb", json.dumps(json.loads(HTB) | {"incumbents": "pose"}), 1.0),
    "pa": ("rpm_pa", "rpm_pa", PA, 1.0),
}
CARDS = {
    "paper": {"baseline": "dcreg_paper", "limits": {"time_s": 10.0}, "language": "Python"},
    "rival": {
        "provenance": "reconstruction",
        "display_name": "RPM-HTB",
        "limits": {"time_s": 10.0},
    },
}
JUDGED = [claim for claim in ledger().claims if not claim.unjudged]


def runs_of(method: str, **columns) -> pd.DataFrame:
    """Runs of one method on the grid; a column is a value, or a function of level and random draw."""
    rng = np.random.default_rng(sum(map(ord, method)))
    _, baseline, options, ratio = METHODS[method]
    rows = []
    for level in LEVELS:
        for trial in range(TRIALS):
            row = {
                "run_id": f"{method}-{level}-{trial}", "instance_id": f"{level}-{trial}",
                "method": method, "display_name": method, "dataset": "d", "shape": "fish",
                "baseline": baseline, "options_effective": options, "n_inliers_ratio": ratio,
                "test": "noise", "level": level, "trial": trial, "model": "similarity2d",
                "experiment": "paper2d", "outcome": "finished", "status": "optimal",
                "success": True, "rmse": 0.05, "rmse_floor": 0.049, "rmse_excess": 0.01,
                "admissible": True, "T_reference": "[]", "time_solve_s": 1.0, "n_source": 98,
                "n_target": 98, "certificate_scope": "similarity pose", "verdict": "right",
                "n_nodes": 100.0, "n_assignments": 1600.0, "objective": 1.0, "gap_tol": 0.1, "gap": 0.05,
                "lower_bound": 0.95, "upper_bound": 1.0, "bound_ratio": 0.95, "objective_best": 1.0,
                "bound_violation": 0.0, "machine_id": "m", "parallel_jobs": 1.0, "extra": "{}",
            }  # fmt: skip
            draw = 1 + 0.1 * rng.random()
            for name, value in columns.items():
                row[name] = value(level, draw) if callable(value) else value
            rows.append(row)
    return pd.DataFrame(rows)


def evidence(*tables: pd.DataFrame, traces: pd.DataFrame | None = None, name="paper2d") -> Evidence:
    made = Tables(
        directory=Path("nowhere"),
        runs=pd.concat(tables, ignore_index=True).assign(experiment=name),
        histories=records.frame([], records.TRACES) if traces is None else traces,
        accounting=pd.DataFrame(),
        provenance={"methods": CARDS, "machine": {"cpu": "a processor"}},
        overlays=[],
    )
    return Evidence({"paper2d": Experiment(made)}, {})


def judged(found: Evidence, *checks: dict, experiment: str = "paper2d", **fields):
    """Judge checks; of a role with choices, one method is enough unless `choices` is kept."""
    book = ledger()
    if not fields.pop("choices", False):
        roles = {name: replace(role, choices=()) for name, role in book.roles.items()}
        book = replace(book, roles=roles)
    return judge_claim(book, Claim("c", "q", "t", experiment, checks, **fields), found)


def figures(check: dict, *tables: pd.DataFrame, **given) -> list[tuple[float, int]]:
    """Figure and number of trials of every comparison of a check."""
    available = evidence(*tables, **given)
    found = CHECKS[check["kind"]](
        Source(available, available.experiments["paper2d"], ledger().roles), check
    )
    return [(part.estimate.value, part.estimate.n) for part in found.parts]


def history(method: str, *steps: tuple[float, float]) -> pd.DataFrame:
    """Bound histories with these times and lower bounds."""
    return pd.DataFrame(
        [
            {
                "run_id": run,
                "stage": "search",
                "time_s": time,
                "n_assignments": 10 * time,
                "lower_bound": low,
                "upper_bound": 1.0,
            }
            for run in runs_of(method)["run_id"]
            for time, low in steps
        ]
    )


def limited(runs: pd.DataFrame, count: int, **columns) -> pd.DataFrame:
    """The runs, the first ones of each level as ended at a limit."""
    at_limit = runs["trial"] < count
    changed = runs.assign(
        outcome=runs["outcome"].mask(at_limit, "limited"),
        status=runs["status"].mask(at_limit, "time_limit"),
    )
    for name, value in columns.items():
        changed.loc[at_limit, name] = value
    return changed


def error(value):
    return lambda level, draw: value * draw


RATIO = {
    "kind": "ratio",
    "subject": "dcreg_paper",
    "rivals": ["rpm_htb"],
    "claimed": {"below": 1.0},
}
TIME = {**RATIO, "quantity": "time"}
VALUE = {"kind": "value", "methods": ["dcreg_paper"], "claimed": {"below": 0.06}}
LOW = {"kind": "low", "methods": ["dcreg_paper"], "claimed": {"at_most": 1}}
RISE = {"kind": "rise", "methods": ["rpm_htb"], "claimed": {"at_least": 3}}
SCATTER = {**RATIO, "kind": "scatter"}
SLOPE = {
    "kind": "slope",
    "methods": ["dcreg_paper"],
    "rivals": ["rpm_htb"],
    "claimed": {"below": 0},
}
TREND = {
    "kind": "trend",
    "methods": ["dcreg_paper"],
    "quantities": ["time"],
    "claimed": {"above": 0},
}
RACE = {**RATIO, "kind": "race", "quantity": "time", "claimed": {"below": 0.5}}
REGRET = {
    "kind": "regret", "subject": "dcreg_paper", "reference": "dcreg", "claimed": {"at_least": 0.8},
}  # fmt: skip
SENSITIVITY = {
    "kind": "sensitivity", "subject": ["dcreg_paper_half", "dcreg_paper"],
    "rival": ["rpm_pa", "rpm_htb"], "quantities": ["n_nodes"], "claimed": {"below": 0.5},
}  # fmt: skip


def noisy(level, draw):
    return 0.001 + 0.1 * (draw - 1)


def spread_over(width):
    return lambda level, draw: 0.05 + width * (draw - 1.05)
