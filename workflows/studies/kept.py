"""Which finished runs a disturbed experiment lost or repeated.

The final table does not show losses, because a continued experiment computes missing runs again. So the
finished runs are noted when a fault strikes, and compared with the final results. Two executions of a run
differ in their time, which practically never agrees to the last digit.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import pandas as pd

from workflows.journal import lines_of

Times = dict[str, set[float]]  # run_id -> time_solve_s of each execution


def finished(results: Path) -> Times:
    """Return the finished runs of an experiment whose lines in the journals are intact."""
    times: Times = defaultdict(set)
    for folder in sorted((results / "runs").glob("*")):
        for _, row in lines_of(folder):
            times[row["run_id"]].add(row["time_solve_s"])
    return dict(times)


def lost_and_repeated(noted: Times, results: Path) -> tuple[int, int]:
    """Count the noted runs without a result, and all runs that were executed more than once.

    Parameters
    ----------
    noted : dict
        What `finished` returned at the disturbance.
    results : Path
        Folder of the continued experiment.

    Returns
    -------
    lost, repeated : int
    """
    journals, table = finished(results), _tabulated(results)
    lost = noted.keys() - (table or journals).keys()
    seen = (noted, journals, table)
    executions = [set().union(*(times.get(run, ()) for times in seen)) for run in journals | table]
    return len(lost), sum(len(times) > 1 for times in executions)


def _tabulated(results: Path) -> Times:
    """Return the runs of the final table, if there is one."""
    path = results / "tables" / "runs.parquet"
    if not path.is_file():
        return {}
    table = pd.read_parquet(path, columns=["run_id", "time_solve_s"])
    return {run: {time} for run, time in table.itertuples(index=False)}
