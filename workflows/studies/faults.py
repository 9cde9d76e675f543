"""Faults during sweeps: ``python -m workflows.studies.faults OUT``.

A sweep of at least 500 runs is disturbed at random moments, by one kind of fault after the other, and
then continued until it is complete. Except for times, its table must equal that of an undisturbed
sweep; no finished run may be lost or repeated. The study writes ``faults.csv``.

Two faults need privileges, and have a substitute without them. A full disk is a small tmpfs for root, and
otherwise a limit on the size of files. The clock is not set back: files get times in the future instead,
which a program sees in the same way. Root ignores permissions, so a file in the place of a folder
simulates a folder that cannot be written.
"""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pandas as pd
import psutil
import typer

from workflows import CHECKOUT
from workflows.exact import differences, read
from workflows.integrity import opened

NAME = "faults"
CONFIG = """
name: faults
chunk_size: 25
limits: {{time_s: 20, memory_mb: 2048, assignments: 500}}
datasets:
  - dataset: embedded
    shapes: [fish, glyph]
    n_points: 10
    trials: {trials}
    tests: {{noise: [0.0, 0.02], separate_outliers: [0.2]}}
methods:
  - {{name: dcreg, baseline: dcreg}}
  - {{name: icp, baseline: icp}}
"""
RUNS_PER_TRIAL = 12  # shapes, levels and methods
MOST_TRIES = 10  # sweeps until the table must be complete
DISK_MB = 1  # of the small disk, less than the results need
FILE_KB = 8  # maximum size of a file, without privileges


@dataclass
class Sweep:
    """A sweep in its own folder, which a fault disturbs."""

    folder: Path
    config: Path
    chance: random.Random
    duration_s: float = 0.0  # of the undisturbed sweep

    @property
    def results(self) -> Path:
        return self.folder / "results" / NAME

    def start(self, **settings: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "workflows", "run", str(self.config)]
        return subprocess.Popen(
            [*command, "--directory", str(self.folder), "--cores", "2", "--no-report"],
            cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **settings,  # type: ignore[call-overload]
        )  # fmt: skip

    def finish(self) -> int:
        """Continue until the table is complete; return the number of sweeps that this took."""
        for tried in range(1, MOST_TRIES + 1):
            with self.start() as process:
                output, _ = process.communicate()
            if process.returncode == 0:
                return tried
        raise RuntimeError(f"not complete after {MOST_TRIES} sweeps:\n{output}")

    def wait(self, process: subprocess.Popen[str]) -> bool:
        """Wait for a random moment after the first finished runs; return whether the sweep still runs."""
        while process.poll() is None and not self.journal_lines():
            time.sleep(0.05)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=self.chance.uniform(0.0, 0.5 * self.duration_s))
        return process.poll() is None

    def family(self, process: subprocess.Popen[str]) -> list[psutil.Process]:
        """Return the sweep's process and all below it."""
        with suppress(psutil.NoSuchProcess):
            top = psutil.Process(process.pid)
            return [top, *top.children(recursive=True)]
        return []

    def workers(self, process: subprocess.Popen[str]) -> list[psutil.Process]:
        """Return the processes in which methods run."""
        found = []
        for each in self.family(process):
            with suppress(psutil.Error):
                if "workflows.stages.worker" in each.cmdline():
                    found.append(each)
        return found

    def journal_lines(self) -> list[str]:
        return [
            line
            for path in sorted(self.results.glob("runs/*/*.journal.jsonl"))
            for line in path.read_text(encoding="utf-8", errors="replace").splitlines()
        ]

    def times_made(self) -> Counter[str]:
        """Return how often each run was finished."""
        rows = map(opened, self.journal_lines())
        return Counter(row["run_id"] for row in rows if row)

    def table(self) -> pd.DataFrame:
        return read(self.results)


# --- the faults: each disturbs a sweep that has begun, and returns whether it struck --------------


def kill_worker(sweep: Sweep) -> bool:
    """As the kernel does if memory runs out."""
    return _signal_worker(sweep, signal.SIGKILL)


def hang_worker(sweep: Sweep) -> bool:
    return _signal_worker(sweep, signal.SIGSTOP)


def crash_worker(sweep: Sweep) -> bool:
    return _signal_worker(sweep, signal.SIGSEGV)


def kill_snakemake(sweep: Sweep) -> bool:
    with sweep.start() as process:
        if struck := sweep.wait(process):
            for child in sweep.family(process)[1:2]:
                child.kill()
        process.communicate()
    return struck


def interrupt(sweep: Sweep) -> bool:
    """Ctrl-C."""
    with sweep.start() as process:
        if struck := sweep.wait(process):
            process.send_signal(signal.SIGINT)
        process.communicate()
    return struck


def restart_machine(sweep: Sweep) -> bool:
    """All processes end at once."""
    with sweep.start() as process:
        if struck := sweep.wait(process):
            for each in sweep.family(process):
                with suppress(psutil.NoSuchProcess):
                    each.kill()
        process.communicate()
    return struck


def start_twice(sweep: Sweep) -> bool:
    """The second invocation must be refused."""
    with sweep.start() as first:
        sweep.wait(first)
        with sweep.start() as second:
            output, _ = second.communicate()
        struck = first.poll() is None
        if struck and "another run uses these results" not in output:
            raise RuntimeError(f"a second invocation was not refused:\n{output}")
        first.communicate()
    return struck


def truncate_files(sweep: Sweep) -> bool:
    """Cut off a quarter of the files of runs and instances, among them the last journal."""
    interrupt(sweep)
    for path in (files := _some_files(sweep)):
        os.truncate(path, sweep.chance.randrange(path.stat().st_size))
    return bool(files)


def corrupt_files(sweep: Sweep) -> bool:
    """Change a byte of a quarter of the files of runs and instances."""
    interrupt(sweep)
    for path in (files := _some_files(sweep)):
        content = bytearray(path.read_bytes())
        content[sweep.chance.randrange(len(content))] ^= 0x55
        path.write_bytes(content)
    return bool(files)


def forbid_writing(sweep: Sweep) -> bool:
    """A file takes the place of a folder of runs, so that nothing can be written there."""
    interrupt(sweep)
    place = sweep.results / "runs" / "icp"
    aside = place.with_name("aside")
    if place.exists():
        place.rename(aside)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.touch()
    with sweep.start() as process:
        process.communicate()
    place.unlink()
    if aside.exists():
        aside.rename(place)
    return process.returncode != 0


def fill_disk(sweep: Sweep) -> bool:
    """The results do not fit on their disk, until it is enlarged."""
    if os.geteuid() != 0 or not _mounted(sweep):
        limit = FILE_KB * 1024
        allow = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))  # noqa: E731
        with sweep.start(preexec_fn=allow) as process:
            process.communicate()
        return process.returncode != 0
    try:
        with sweep.start() as process:
            process.communicate()
        kept = sweep.folder.with_name("kept")
        shutil.copytree(sweep.folder, kept)
    finally:
        subprocess.run(["umount", str(sweep.folder)], check=True)
    shutil.copytree(kept, sweep.folder, dirs_exist_ok=True)
    shutil.rmtree(kept)
    return process.returncode != 0


def set_clock_back(sweep: Sweep) -> bool:
    """Files are from the future."""
    interrupt(sweep)
    ahead = time.time() + 7 * 24 * 3600.0
    files = [path for path in sorted(sweep.results.rglob("*")) if path.is_file()]
    for path in (some := sweep.chance.sample(files, len(files) // 2)):
        os.utime(path, (ahead, ahead))
    return bool(some)


FAULTS: dict[str, Callable[[Sweep], bool]] = {
    fault.__name__: fault
    for fault in (
        kill_worker, hang_worker, crash_worker, kill_snakemake, interrupt, restart_machine, start_twice,
        truncate_files, corrupt_files, forbid_writing, fill_disk, set_clock_back,
    )
}  # fmt: skip


def _signal_worker(sweep: Sweep, number: int) -> bool:
    struck = False
    with sweep.start() as process:
        if sweep.wait(process) and (workers := sweep.workers(process)):
            with suppress(psutil.NoSuchProcess):
                sweep.chance.choice(workers).send_signal(number)
                struck = True
        process.communicate()
    return struck


def _some_files(sweep: Sweep) -> list[Path]:
    files = [
        path
        for part in ("runs", "instances", "truth")
        for path in sorted((sweep.results / part).rglob("*"))
        if path.is_file() and path.suffix in (".parquet", ".npz", ".jsonl") and path.stat().st_size
    ]
    return sweep.chance.sample(files, max(1, len(files) // 4))


def _mounted(sweep: Sweep) -> bool:
    """Mount a small disk at the folder of a sweep; return whether that is possible."""
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(sweep.folder)],
        capture_output=True,
    )
    return done.returncode == 0


# --- the study ---------------------------------------------------------------------------------


def main(
    out: Annotated[Path, typer.Argument(help="folder for the table and the sweeps")],
    runs: Annotated[int, typer.Option(help="minimum number of runs of a sweep")] = 500,
    only: Annotated[list[str] | None, typer.Option(help="faults; default: all")] = None,
    seed: Annotated[int, typer.Option(help="of the random moments")] = 0,
) -> None:
    """Disturb a sweep by every fault; print and store what was lost and repeated."""
    rows = study(out, runs, only or list(FAULTS), seed)
    print(rows.to_string(index=False))
    rows.to_csv(out / "faults.csv", index=False)
    if not (rows["survived"] & rows["struck"]).all():
        raise typer.Exit(1)


def study(out: Path, runs: int, names: Sequence[str], seed: int) -> pd.DataFrame:
    """Return a row for each fault: whether it struck, runs, lost, repeated, differing cells, sweeps."""
    out = out.resolve()
    shutil.rmtree(out / "sweeps", ignore_errors=True)
    (out / "sweeps").mkdir(parents=True)
    config = out / f"{NAME}.yaml"
    config.write_text(CONFIG.format(trials=-(-runs // RUNS_PER_TRIAL)), encoding="utf-8")
    undisturbed = _sweep(out, config, "undisturbed", seed)
    began = time.monotonic()
    undisturbed.finish()
    duration_s = time.monotonic() - began
    print(f"undisturbed: {len(undisturbed.table())} runs in {duration_s:.0f} s", flush=True)
    rows = []
    for name in names:
        sweep = _sweep(out, config, name, seed)
        sweep.duration_s = duration_s
        struck = FAULTS[name](sweep)
        rows.append(_row(name, struck, sweep, sweep.finish(), undisturbed.table()))
        print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def _sweep(out: Path, config: Path, name: str, seed: int) -> Sweep:
    folder = out / "sweeps" / name
    folder.mkdir()
    return Sweep(folder, config, random.Random(f"{name} {seed}"))


def _row(
    name: str, struck: bool, sweep: Sweep, sweeps: int, expected: pd.DataFrame
) -> dict[str, object]:
    table = sweep.table()
    lost = len(set(expected["run_id"]) - set(table["run_id"]))
    found = differences(expected, table)
    repeated = sum(count - 1 for count in sweep.times_made().values())
    return {
        "fault": name, "struck": struck, "runs": len(table), "lost": lost, "repeated": repeated,
        "different": len(found.cells), "sweeps": 1 + sweeps,
        "survived": not (lost or repeated or len(found.cells)),
    }  # fmt: skip


if __name__ == "__main__":
    typer.run(main)
