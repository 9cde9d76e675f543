"""Faults during sweeps: ``python -m workflows.studies.faults OUT``.

A sweep of at least 500 runs is disturbed at random moments, by one kind of fault after the other, and
then continued until it is complete. Except for times, its table must equal that of an undisturbed
sweep. Runs that were finished and intact at the fault may not be lost or repeated: see `kept`. The study
writes ``faults.csv``.

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
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated

import pandas as pd
import psutil
import typer

from workflows import CHECKOUT
from workflows.exact import differences, read
from workflows.integrity import SUFFIXES, SUMS
from workflows.studies.kept import Times, finished, lost_and_repeated

NAME = "faults"
UNDISTURBED = "undisturbed"
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
DISK_SHARE = 0.5  # of the size of the undisturbed sweep, which the small disk has
FILE_KB = 8  # maximum size of a file, without privileges


@dataclass
class Sweep:
    """A sweep in its own folder, which a fault disturbs."""

    folder: Path
    config: Path
    chance: random.Random
    n_runs: int = 0
    intact: Times = field(default_factory=dict)  # the finished runs at the fault

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
        """Continue until the table is complete; return the number of sweeps that this took, or 0."""
        for tried in range(1, MOST_TRIES + 1):
            with self.start() as process:
                output, _ = process.communicate()
            if process.returncode == 0:
                return tried
        print(f"not complete after {MOST_TRIES} sweeps:\n{output}", flush=True)
        return 0

    def note(self) -> None:
        """Note the finished runs; of a run noted before, the first execution counts."""
        self.intact = finished(self.results) | self.intact

    def wait(self, process: subprocess.Popen[str]) -> bool:
        """Wait until a random number of runs is finished; return whether the sweep still runs.

        It is at most half of the runs, so that a fault also meets a short sweep at work.
        """
        count = self.chance.randint(1, self.n_runs // 2)
        while process.poll() is None and len(finished(self.results)) < count:
            time.sleep(0.05)
        self.note()
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

    def table(self) -> pd.DataFrame:
        return read(self.results)


# --- the faults: each disturbs a sweep that has begun, and returns whether it struck --------------


def kill_worker(sweep: Sweep) -> bool:
    """As the kernel does if memory runs out."""
    return _disturb_worker(sweep, lambda worker: worker.send_signal(signal.SIGKILL))


def hang_worker(sweep: Sweep) -> bool:
    return _disturb_worker(sweep, lambda worker: worker.send_signal(signal.SIGSTOP))


def crash_worker(sweep: Sweep) -> bool:
    return _disturb_worker(sweep, lambda worker: worker.send_signal(signal.SIGSEGV))


def exhaust_memory(sweep: Sweep) -> bool:
    """The worker gets no more memory."""

    def refuse(worker: psutil.Process) -> None:
        _, most = worker.rlimit(psutil.RLIMIT_AS)
        worker.rlimit(psutil.RLIMIT_AS, (1, most))

    return _disturb_worker(sweep, refuse)


def kill_snakemake(sweep: Sweep) -> bool:
    return _stop(sweep, signal.SIGKILL, slice(1, 2))


def interrupt(sweep: Sweep) -> bool:
    """Ctrl-C."""
    return _stop(sweep, signal.SIGINT, slice(0, 1))


def restart_machine(sweep: Sweep) -> bool:
    """All processes end at once."""
    return _stop(sweep, signal.SIGKILL, slice(None))


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
    """Cut off a quarter of the files of an unfinished sweep."""
    interrupt(sweep)
    return _damage(sweep, lambda content, at: content[:at])


def corrupt_files(sweep: Sweep) -> bool:
    """Change a byte of a quarter of the files of an unfinished sweep."""
    interrupt(sweep)
    return _damage(sweep, _change_byte)


def corrupt_results(sweep: Sweep) -> bool:
    """Change a byte of a quarter of the files of a finished sweep, which has tables."""
    sweep.finish()
    return _damage(sweep, _change_byte)


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
    sweep.note()
    return process.returncode != 0


def fill_disk(sweep: Sweep) -> bool:
    """The results do not fit on their disk, until it is enlarged."""
    if os.geteuid() != 0 or not _mounted(sweep):
        interrupt(sweep)
        limit = FILE_KB * 1024
        allow = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))  # noqa: E731
        with sweep.start(preexec_fn=allow) as process:
            process.communicate()
        sweep.note()
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
    sweep.note()
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
        kill_worker, hang_worker, crash_worker, exhaust_memory, kill_snakemake, interrupt,
        restart_machine, start_twice, truncate_files, corrupt_files, corrupt_results, forbid_writing,
        fill_disk, set_clock_back,
    )
}  # fmt: skip


def _disturb_worker(sweep: Sweep, disturb: Callable[[psutil.Process], None]) -> bool:
    struck = False
    with sweep.start() as process:
        if sweep.wait(process) and (workers := sweep.workers(process)):
            with suppress(psutil.NoSuchProcess):
                disturb(sweep.chance.choice(workers))
                struck = True
        process.communicate()
    return struck


def _stop(sweep: Sweep, number: int, part: slice) -> bool:
    """Send a signal to a part of the processes, of which Snakemake is the second."""
    with sweep.start() as process:
        if struck := sweep.wait(process):
            for each in sweep.family(process)[part]:
                with suppress(psutil.NoSuchProcess):
                    each.send_signal(number)
        process.communicate()
    sweep.note()
    return struck


def _damage(sweep: Sweep, change: Callable[[bytes, int], bytes]) -> bool:
    """Change a quarter of the files that have checksums, journals and lists of checksums at a byte."""
    files = [
        path
        for path in sorted(sweep.results.rglob("*"))
        if (path.suffix in (*SUFFIXES, ".jsonl") or path.name == SUMS) and path.stat().st_size
    ]
    for path in (some := sweep.chance.sample(files, -(-len(files) // 4))):
        content = path.read_bytes()
        path.write_bytes(change(content, sweep.chance.randrange(len(content))))
    sweep.intact = finished(sweep.results)  # only what was damaged may be executed again
    return bool(some)


def _change_byte(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :]


def _mounted(sweep: Sweep) -> bool:
    """Mount a small disk at the folder of a sweep; return whether that is possible."""
    files = sweep.folder.with_name(UNDISTURBED).rglob("*")
    size = int(DISK_SHARE * sum(path.stat().st_size for path in files if path.is_file()))
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(sweep.folder)]
    return subprocess.run(command, capture_output=True).returncode == 0


# --- the study ---------------------------------------------------------------------------------


def main(
    out: Annotated[Path, typer.Argument(help="folder for the table and the sweeps")],
    runs: Annotated[int, typer.Option(help="minimum number of runs of a sweep")] = 500,
    only: Annotated[list[str] | None, typer.Option(help="faults; default: all")] = None,
    seed: Annotated[int, typer.Option(help="of the random moments")] = 0,
    moments: Annotated[int, typer.Option(help="random moments for each fault")] = 1,
) -> None:
    """Disturb a sweep by every fault; print and store what was lost and repeated."""
    rows = study(out, runs, only or list(FAULTS), seed, moments)
    print(rows.to_string(index=False))
    rows.to_csv(out / "faults.csv", index=False)
    if not rows["survived"].all():
        raise typer.Exit(1)


def study(out: Path, runs: int, names: Sequence[str], seed: int, moments: int = 1) -> pd.DataFrame:
    """Return a row for each fault and moment: whether it was survived, and the counts behind that."""
    out = out.resolve()
    shutil.rmtree(out / "sweeps", ignore_errors=True)
    (out / "sweeps").mkdir(parents=True)
    config = out / f"{NAME}.yaml"
    config.write_text(CONFIG.format(trials=-(-runs // RUNS_PER_TRIAL)), encoding="utf-8")
    undisturbed = _sweep(out, config, UNDISTURBED, seed)
    if not undisturbed.finish():
        raise RuntimeError("the undisturbed sweep is not complete")
    expected = undisturbed.table()
    rows = []
    for name, moment in product(names, range(moments)):
        sweep = _sweep(out, config, f"{name}_{moment}", seed)
        sweep.n_runs = len(expected)
        struck = FAULTS[name](sweep)
        rows.append(_row(name, struck, sweep, sweep.finish(), expected))
        print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def _sweep(out: Path, config: Path, name: str, seed: int) -> Sweep:
    folder = out / "sweeps" / name
    folder.mkdir()
    return Sweep(folder, config, random.Random(f"{name} {seed}"))


def _row(
    name: str, struck: bool, sweep: Sweep, sweeps: int, expected: pd.DataFrame
) -> dict[str, object]:
    """Return the row of a fault; one that met no finished run proves nothing, so it is not survived."""
    lost, repeated = lost_and_repeated(sweep.intact, sweep.results)
    table = sweep.table() if sweeps else expected.head(0)
    missing = len(expected.index.difference(table.index))
    different = len(differences(expected, table).cells) if sweeps else 0
    proves = struck and bool(sweep.intact)
    return {
        "fault": name, "survived": proves and not (lost or repeated or different or missing),
        "lost": lost, "repeated": repeated, "different": different, "intact_at_fault": len(sweep.intact),
        "runs": len(table), "struck": struck, "sweeps": 1 + sweeps,
    }  # fmt: skip


if __name__ == "__main__":
    typer.run(main)
