"""Run an experiment on a Slurm cluster whose only node is lost in the middle: ``make test-slurm``.

Times excepted, the table must be that of a local run. No run may be lost or made again. The test needs
root, installs the distribution's packages of Slurm, and is skipped where that is impossible.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from tests.slurm.cluster import Cluster, SkippedError, check_machine, cluster, install
from workflows import CHECKOUT, UserError
from workflows.exact import differences, read
from workflows.running import INTERRUPTED, find_profile
from workflows.studies.kept import Times, finished, lost_and_repeated

NAME = "slurm"
# 204 runs in six solve jobs, of which pairs share a job of Slurm. The limit on work makes tables equal.
CONFIG = """
name: slurm
chunk_size: 34
limits: {time_s: 10, memory_mb: 1000, assignments: 500, safety_s: 15}
datasets:
  - dataset: embedded
    shapes: [fish, glyph]
    n_points: 20
    trials: 17
    tests: {noise: [0.02], separate_outliers: [0.2], deformation: [0.03]}
methods:
  - {name: dcreg, baseline: dcreg}
  - {name: icp, baseline: icp}
"""
RUNS = 204
PROFILES = ("--profile", "slurm", "--profile", "tests/slurm")
LIMIT_S = 300.0  # of one call

_began = time.monotonic()


def say(text: str) -> None:
    print(f"{time.monotonic() - _began:6.0f} s  {text}", flush=True)


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "workflows", "run", str(folder.parent / f"{NAME}.yaml")]
    command += ["--directory", str(folder), "--no-report", "--fresh", *arguments]
    return subprocess.Popen(
        command, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def finish(process: subprocess.Popen[str], code: int = 0) -> None:
    """Wait for a call and check its exit code; one that hangs is killed."""
    try:
        output, _ = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=30)
        process.kill()
        raise
    if process.returncode != code:
        raise RuntimeError(f"exit code {process.returncode} instead of {code}:\n{output}")


def lose_the_node(running: Cluster, folder: Path) -> Times:
    """Run until a third of the runs is finished, then lose the node and interrupt the call.

    Returns
    -------
    dict
        The runs that were finished when the node was lost.
    """
    results = folder / "results" / NAME
    process = start(folder, *PROFILES)
    deadline = time.monotonic() + LIMIT_S
    while len(finished(results)) < RUNS // 3:
        if process.poll() is not None or time.monotonic() > deadline:
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate()
            raise RuntimeError(
                f"{len(finished(results))} runs before the loss of the node:\n{output}"
            )
        time.sleep(0.2)
    jobs = running.kill_node()
    noted = finished(results)
    say(f"killed slurmd and {jobs} jobs after {len(noted)} of {RUNS} runs")
    assert jobs
    assert 0 < len(noted) < RUNS
    running.wait_until_down()
    say("Slurm reported the node as down")
    process.send_signal(signal.SIGINT)
    finish(process, code=INTERRUPTED)
    say("interrupted the run")
    running.start_node()
    say(f"restarted slurmd; jobs left: {running.jobs() or 'none'}")
    return noted


def main() -> None:
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # after the cleanup
    try:
        find_profile("slurm")
        check_machine()
        say("installed Slurm" if install() else "Slurm is installed")
    except (SkippedError, UserError) as error:
        print(f"skipped   make test-slurm: {error}")
        return
    with tempfile.TemporaryDirectory(prefix="test-slurm-") as name:
        root = Path(name)
        (root / f"{NAME}.yaml").write_text(CONFIG, encoding="utf-8")
        local, remote = root / "local", root / "remote"
        finish(start(local, "--cores", "2"))
        say("finished the local run")
        with cluster() as running:
            say("started the cluster")
            noted = lose_the_node(running, remote)
            finish(start(remote, *PROFILES))
            say("finished the run on the cluster by the same command")
        expected, found = (read(folder / "results" / NAME) for folder in (local, remote))
        differing = differences(expected, found)
        lost, repeated = lost_and_repeated(noted, remote / "results" / NAME)
        say(
            f"{len(found)} runs, {lost} lost, {repeated} repeated, {len(differing.cells)} different "
            "values (times not compared)"
        )
        if len(found) != RUNS or lost or repeated or len(differing.cells) or differing.unmatched:
            print(differing.cells.head(20).to_string())
            sys.exit(1)


if __name__ == "__main__":
    main()
