"""The same tables with one thread and one job at a time as with two, in another order of jobs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal

from workflows import CHECKOUT
from workflows.exact import differences, read

# Work is limited, not time: how far a search gets in a second is not repeatable.
CONFIG = """
name: same
seed: 3
limits: {{time_s: 300, memory_mb: 3000, nodes: 100, assignments: 100, threads: {threads}}}
datasets:
  - {{dataset: embedded, shapes: [fish], n_points: 14, tests: {{mixed_outliers: [0.2]}}}}
  - {{dataset: embedded, shapes: [pony], n_points: 20, tests: {{noise: [0.01]}}}}
methods:
"""
METHODS = [
    "  - {name: dcreg, baseline: dcreg}\n",
    "  - {name: goicp, baseline: goicp, models: [rigid3d]}\n",
    "  - {name: random, baseline: fpfh_ransac, models: [rigid3d]}\n",
]

pytestmark = [pytest.mark.workflow, pytest.mark.slow]


def results(root: Path, threads: int, methods: list[str]) -> Path:
    """Run the experiment with so many threads and cores; return the folder of its results."""
    config, place = root / f"{threads}.yaml", root / str(threads)
    config.write_text(CONFIG.format(threads=threads) + "".join(methods))
    options = ["--cores", str(threads), "--fresh", "--no-report", "--directory", str(place)]
    command = [sys.executable, "-m", "workflows", "run", str(config), *options]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return place / "results" / "same"


def by_method(table: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Name runs by method and instance: the number of threads is a part of their ids."""
    names = runs["method"] + " " + runs["instance_id"]
    names.index = runs["run_id"]
    table = table.assign(run_id=names.loc[table["run_id"]].to_numpy())
    return table.set_index("run_id", drop=False).sort_index(kind="stable")


def test_tables_do_not_depend_on_threads_cores_or_order(tmp_path):
    """Except for those of a method that is not deterministic: they are labelled."""
    folders = [results(tmp_path, 1, METHODS), results(tmp_path, 2, METHODS[::-1])]
    one, two = (by_method(table, table) for table in map(read, folders))
    assert len(one) == 1 + 3
    assert (one["is_timed"] | two["is_timed"]).sum() == 0
    for table in (one, two):
        assert set(table.loc[table["is_random"], "method"]) == {"random"}
    found = differences(one, two)
    random = found.cells["reason"] == "random"
    assert not found.cells[~random].to_dict("records")
    assert not found.unexplained

    histories, counts = [], []
    for folder in folders:
        runs = pd.read_parquet(folder / "tables/runs.parquet")
        events = by_method(pd.read_parquet(folder / "tables/traces.parquet"), runs)
        histories.append(events.drop(columns="time_s"))
        counted = pd.read_csv(folder / "tables/accounting.csv", index_col="method")
        counts.append(counted.drop("random").sort_index())
    searches = one.index[one["baseline"].isin(["dcreg", "goicp"])]
    assert len(searches) == 3
    assert set(searches) <= set(histories[0]["run_id"])
    assert_frame_equal(*histories)
    assert_frame_equal(*counts)
