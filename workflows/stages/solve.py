"""One solve job: a method on a chunk of instances; every finished run is stored at once.

Next to the final file is a journal with one line per finished run. A job that was interrupted, or whose
chunk has changed, takes from the journals of the method, and from archives, all runs with the same
run_id, input and method fingerprint, and solves the rest.
"""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from baselines import registry
from baselines.contract import Instance
from dcreg.files import whole_file
from dcreg.problem import exact_objective
from dcreg.search import proven_share
from dcreg.status import Status
from workflows import provenance, records
from workflows.archives import archived
from workflows.config import Experiment, MethodSettings
from workflows.instances import content_digest, read_problems, read_truths, with_oracle
from workflows.integrity import opened, sealed
from workflows.journal import appending, journalled, key_of
from workflows.outcomes import stated
from workflows.stages.kills import Kills
from workflows.stages.plan import method_identity, run_identity
from workflows.stages.progress import Reporter
from workflows.stages.sandbox import Sandbox


def solve(
    experiment: Experiment,
    method: MethodSettings,
    instances_path: Path,
    runs_path: Path,
    say: Callable[[str], None] = print,
    truth_path: Path | None = None,
) -> None:
    """Write ``<chunk>.parquet`` and ``<chunk>.trace.parquet`` with a row for every instance.

    The ground truth is read only for methods with the oracle front end, which receive its pairs among
    random ones.
    """
    problems = read_problems(instances_path)
    instances = [
        problem.for_solver(method.n_inliers_ratio, experiment.seed, method.n_points)
        for problem in problems
    ]
    refused = {each.instance_id: each.lacks_points(method.n_inliers_ratio) for each in problems}
    outliers = registry.oracle_outliers(method.baseline, method.options)
    if outliers is not None and truth_path is not None:
        truths = read_truths(truth_path)
        instances = [with_oracle(each, truths[each.instance_id], outliers) for each in instances]
    runs_path.parent.mkdir(parents=True, exist_ok=True)
    title = f"solve     {method.name:<16} {runs_path.stem:<14}"
    start = time.monotonic()
    rows = list(_rows(experiment, method, instances, runs_path, refused))
    counts = Counter(row["status"] for row in rows)
    ended = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    say(f"{title} {len(rows)} runs: {ended}; {time.monotonic() - start:.1f} s")

    events = [
        {"run_id": row["run_id"], "instance_id": row["instance_id"], **event}
        for row in rows
        for event in row.get("trace", ())
    ]
    records.write(
        records.frame(events, records.RAW_TRACES), runs_path.with_suffix(".trace.parquet")
    )
    records.write(records.frame(rows, records.RAW), runs_path)


def forget(runs_folder: Path, statuses: set[str]) -> int:
    """Delete runs with the given statuses from a folder of results, so that they are repeated."""
    dropped = 0
    for path in sorted(runs_folder.glob("*/*.journal.jsonl")):
        kept, lines = [], path.read_text(encoding="utf-8", errors="replace").splitlines()
        for line in lines:
            entry = opened(line)
            if entry and entry["status"] not in statuses:
                kept.append(line)
        if len(kept) < len(lines):
            dropped += len(lines) - len(kept)
            with whole_file(path) as part:
                part.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
            path.with_name(path.name.replace(".journal.jsonl", ".parquet")).unlink(missing_ok=True)
    return dropped


def _rows(
    experiment: Experiment,
    method: MethodSettings,
    instances: list[Instance],
    runs_path: Path,
    refused: Mapping[str, str],
) -> Iterator[dict[str, Any]]:
    """Yield a row per instance, in order: from a journal, solved now, or `refused` with the reason."""
    jobs = os.environ.get("DCREG_PARALLEL_JOBS", "1")
    constant = {
        "fingerprint": registry.fingerprint(method.baseline, options=method.options),
        "machine_id": provenance.machine_card()["machine_id"],
        "parallel_jobs": float(jobs) if jobs else None,
    }
    finished = {**archived(method.name), **journalled(runs_path.parent)}
    settings = method_identity(experiment, method)
    log = runs_path.with_suffix(".log")
    journal_path = runs_path.with_suffix(".journal.jsonl")
    limits = experiment.limits_of(method)
    kills, reporter = Kills(runs_path), Reporter(method.name, runs_path)
    with (
        reporter,
        Sandbox(method, limits, log, reporter.alive) as sandbox,
        appending(journal_path) as journal,
    ):
        for instance in instances:
            since = time.perf_counter()
            identity = {
                "run_id": run_identity(settings, instance.instance_id),
                "instance_id": instance.instance_id,
                "instance_digest": content_digest(instance),
                "n_source": len(instance.source),
                "n_target": len(instance.target),
                "n_inliers": instance.n_inliers,
                "seed": instance.seed,
                **constant,
            }
            if reason := refused[instance.instance_id]:
                yield {**identity, **_plain({"status": Status.UNSUPPORTED, "message": reason}, 0.0)}
                continue
            if row := finished.get(key_of(identity)):
                yield row
                continue
            reporter.begin(instance.instance_id)
            started = sandbox.time_started_s
            if reason := kills.reason_against(instance.instance_id):
                answer = {"status": Status.FAILED, "message": reason}
            else:
                answer = sandbox.solve(instance)
            row = {**identity, **_plain(answer, exact_fit(instance))}
            waited = time.perf_counter() - since - (sandbox.time_started_s - started)
            if "peak_memory_mb" in row:  # the worker answered; it was not lost
                row["time_overhead_s"] = waited - row["time_solve_s"]
            if row["status"] != Status.UNAVAILABLE:
                journal.write(sealed(row) + "\n")
                journal.flush()
                os.fsync(journal.fileno())  # also a power cut costs no finished run
            yield row
    kills.clear()
    if log.is_file() and not log.stat().st_size:
        log.unlink()


def _plain(answer: dict[str, Any], exact: float) -> dict[str, Any]:
    """Return a worker's answer in the columns of `records.RAW`; `exact` is that of `bound_ratio`."""
    lower, upper = answer.get("lower_bound"), answer.get("upper_bound")
    pose, ratio = answer.get("T_target_source"), bound_ratio(lower, upper, exact)
    return {
        **answer,
        "status": stated(Status(answer["status"]).value, ratio),
        "T_target_source": json.dumps(pose) if pose else "",
        "gap": max(0.0, upper - lower) if lower is not None and upper is not None else None,
        "bound_ratio": ratio,
        "extra": json.dumps(answer.get("extra", {})),
    }


def exact_fit(instance: Instance) -> float:
    """Return the objective up to which a fit counts as exact."""
    return exact_objective(instance.source, instance.target, instance.n_inliers)


def bound_ratio(lower: float | None, upper: float | None, exact: float) -> float | None:
    """Return the lower bound divided by the upper bound; 1 for an exact fit.

    Other objectives than sums of squares can be negative; then only a closed gap has a ratio.

    Parameters
    ----------
    lower, upper : float or None
    exact : float
        The upper bound up to which the fit counts as exact.
    """
    if lower is None or upper is None:
        return None
    if upper < 0.0:
        return 1.0 if lower >= upper else None
    return 1.0 if upper <= exact else proven_share(lower, upper)
