"""Made-up records of versions."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd

from workflows import recording
from workflows.records import SCHEMA_VERSION

N_RUNS = 20


def table(rng: np.random.Generator, method: str = "dcreg") -> pd.DataFrame:
    """A recorded version of one bounding method: certified runs, the last two at the time limit."""
    runs = pd.DataFrame(
        {
            "run_id": [f"r{i}" for i in range(N_RUNS)],
            "method": method,
            "instance_id": [f"i{i}" for i in range(N_RUNS)],
            "instance_digest": [f"d{i}" for i in range(N_RUNS)],
            "dataset": "embedded",
            "shape": "fish",
            "test": "noise",
            "level": 0.1,
            "trial": range(N_RUNS),
            "n_inliers": 10,
            "status": ["optimal"] * (N_RUNS - 2) + ["time_limit"] * 2,
            "n_nodes": rng.integers(100, 1000, N_RUNS),
            "n_assignments": rng.integers(1000, 10000, N_RUNS),
            "gap": rng.random(N_RUNS),
            "objective": rng.random(N_RUNS),
            "rmse": rng.random(N_RUNS),
            "success": True,
            "bound_violation": 0.0,
            "time_solve_s": 0.1 + rng.random(N_RUNS),
            "machine_id": "m",
            "gap_integral_boxes": 10 + rng.random(N_RUNS),
        }
    )
    return runs.reindex(columns=list(recording.columns()))


def about(folder, version=SCHEMA_VERSION):
    content = {"schema_version": version, "git": {"commit": "abc123"}}
    (folder / "about.json").write_text(json.dumps(content))


def write_record(folder, runs: pd.DataFrame, created: str = "2026-01-01") -> None:
    """Write a record with everything that the history page shows."""
    folder.mkdir(parents=True)
    runs.to_parquet(folder / recording.RUNS)
    content = {
        "schema_version": SCHEMA_VERSION, "created": created, "git": {"commit": "c" * 40, "dirty": False},
        "machine": {"cpu": "A CPU", "cores": 2}, "lock_sha256": "a" * 64,
        "versions": {"python": "3.11", "numpy": "2.4", "numba": "0.68"},
        "methods": {name: {"display_name": name.upper()} for name in set(runs["method"])},
    }  # fmt: skip
    (folder / recording.ABOUT).write_text(json.dumps(content))
