"""Run Snakemake over an experiment: one run at a time per folder of results, with an orderly end."""

from __future__ import annotations

import fcntl
import gc
import importlib.util
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory
from types import FrameType
from typing import IO, TYPE_CHECKING, NamedTuple

import yaml

from dcreg.problem import suggestion
from workflows import CHECKOUT, UserError, forking, provenance
from workflows.blocks import EVIDENCE
from workflows.config import Experiment
from workflows.integrity import set_aside_damaged
from workflows.stages import commands

if TYPE_CHECKING:
    from workflows.live import View
    from workflows.stages.plan import Plan

INTERRUPTED = 130  # exit code, as in shells
USER_ERROR = 2  # exit code of `workflows.cli.user_errors`, which prints the reason
PATIENCE_S = 20.0  # for Snakemake to end after SIGTERM
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PROFILES = CHECKOUT / "workflows" / "profiles"
PROFILE = "profile.yaml"
# Snakemake is forked, so it need not import what this process has imported.
_context = multiprocessing.get_context("fork")


class BusyError(UserError):
    """Another run uses these results; the message names it."""


class Profile(NamedTuple):
    """Settings of Snakemake for a cluster or another machine, and the executor that they name."""

    path: Path
    executor: str

    @property
    def is_remote(self) -> bool:
        """Whether jobs run elsewhere."""
        return self.executor not in ("", "local")


def find_profile(name: str) -> Profile:
    """Return a profile, given by name, such as ``slurm``, or by the path of its folder or file.

    Raises
    ------
    UserError
        There is no such profile, or its executor plug-in is not installed.
    """
    known = sorted(path.parent.name for path in PROFILES.glob(f"*/{PROFILE}"))
    path = PROFILES / name if name in known else Path(name)
    path = path / PROFILE if path.is_dir() else path
    if not path.is_file():
        raise UserError(
            f"--profile {name}: no such profile{suggestion(name, known)}; give one of "
            f"{', '.join(known)}, or the path of a folder with {PROFILE}"
        )
    settings = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(settings, dict):
        raise UserError(f"{path}: must map the names of Snakemake's options to their values")
    executor = str(settings.get("executor", ""))
    package = f"snakemake-executor-plugin-{executor}"
    profile = Profile(path.resolve(), executor)
    if profile.is_remote and not importlib.util.find_spec(package.replace("-", "_")):
        raise UserError(
            f"{path}: executor {executor} needs the package {package}; install it with "
            "`.venv/bin/pip install --no-deps --require-hashes --requirement requirements-cluster.lock`"
        )
    return profile


def cores_of_job(experiment: Experiment) -> str:
    """Return the cores of a job on a cluster: solve jobs that share one run one after the other."""
    return str(max(experiment.limits_of(method).threads for method in experiment.methods))


def run_snakemake(
    directory: Path,
    name: str,
    arguments: Sequence[str],
    profiles: Sequence[Profile] = (),
    view_of: Callable[[], View] | None = None,
    end: float = float("inf"),
    plan: Plan | None = None,
) -> int:
    """Run Snakemake on experiment `name` below `directory`; return its exit code, or `INTERRUPTED`.

    The arguments must end with those of ``--config``. Later profiles override earlier ones. `view_of`
    makes the view of the running experiment, after damaged results were set aside. `plan` must be that of
    the arguments; without it, Snakemake reads the config.

    Snakemake and its jobs form a separate process group. At Ctrl-C, SIGTERM or SIGHUP, or when
    `time.monotonic` reaches `end`, they receive SIGTERM, at which Snakemake starts no new job. At a
    second signal, or after `PATIENCE_S`, they are killed. Only unfinished runs are lost. With jobs on a
    cluster, Snakemake receives SIGINT, at which it cancels them.

    Raises
    ------
    BusyError
    """
    words = [
        *("--snakefile", str(CHECKOUT / "Snakefile")),
        *("--keep-going", "--rerun-incomplete", "--quiet", "all"),
        "--force-use-threads",  # otherwise each job is run by another Snakemake
        *("--scheduler", "greedy"),  # the default solves an integer programme whenever a job ends
        # `the_only_run` has the lock: Snakemake's own lock would remain after a kill.
        *("--nolock", "--directory", str(directory)),
        *(word for profile in profiles for word in ("--profile", str(profile.path))),
        *arguments,
    ]
    gentle = signal.SIGINT if any(each.is_remote for each in profiles) else signal.SIGTERM
    deadline = float("inf")  # for Snakemake to end

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal deadline
        if deadline < float("inf"):
            deadline = 0.0
            return
        deadline = time.monotonic() + PATIENCE_S
        print("\nstopping … (press again to kill)", file=sys.stderr, flush=True)
        os.killpg(pid, gentle)

    with (
        the_only_run(directory, name) as lock,
        NamedTemporaryFile("r", encoding="utf-8") as errors,
        TemporaryDirectory(dir=directory / "results" / name, prefix=".sources-") as sources,
    ):
        _set_aside_damaged(directory / "results" / name)
        _correct_times(directory / "results" / name)
        view = view_of() if view_of else None
        pipe = os.pipe() if view and view.is_live else None
        words += [f"errors={errors.name}", "--runtime-source-cache-path", sources]
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # or the end of a child may not be seen
        process = _context.Process(target=_snakemake, args=(words, plan, pipe))
        with _held_back(ENDING):  # until both processes have their handlers
            before = {number: signal.getsignal(number) for number in ENDING}
            process.start()
            pid = process.pid or 0
            for number in ENDING:
                signal.signal(number, interrupt)
        try:
            with suppress(OSError):  # the process does the same
                os.setpgid(pid, pid)
            _write(lock, f"process {os.getpid()} (its Snakemake is process {pid})")
            with view or nullcontext():
                output = view.follow(_received(*pipe)) if view and pipe else None
                while process.exitcode is None:
                    if time.monotonic() > deadline:
                        os.killpg(pid, signal.SIGKILL)
                    elif time.monotonic() > end and deadline == float("inf"):
                        interrupt(signal.SIGTERM, None)
                    process.join(timeout=0.5)
                    if view:
                        view.update()
                if output:
                    output.join(timeout=PATIENCE_S)
        finally:
            if process.exitcode is None:  # an error here
                os.killpg(pid, gentle)
            for number, handler in before.items():
                signal.signal(number, handler)
        has_failed = process.exitcode and deadline == float("inf")
        if has_failed and (text := _unexplained(errors.read())):
            print(text, file=sys.stderr)
    return process.exitcode or 0 if deadline == float("inf") else INTERRUPTED


@contextmanager
def _held_back(signals: Iterable[signal.Signals]) -> Iterator[None]:
    """A context in which these signals wait, also for a process that is forked in it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _snakemake(words: Sequence[str], plan: Plan | None, pipe: tuple[int, int] | None) -> None:
    """Run Snakemake as the only purpose of this process, with its messages to a pipe, if there is one.

    It does not use the handlers of signals, the streams and the server of stages of the parent process.
    """
    gc.freeze()  # what it shares with the parent process is not copied
    os.setpgid(0, 0)
    for number in ENDING:
        if callable(signal.getsignal(number)):
            usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            signal.signal(number, usual)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    if pipe:
        reader, writer = pipe
        # Otherwise writing would block, not fail, once the parent process has died.
        os.close(reader)
        os.dup2(writer, 1)
        os.dup2(writer, 2)
        os.close(writer)
    stream = partial(open, mode="w", encoding="utf-8", errors="backslashreplace", buffering=1)
    sys.stdout, sys.stderr = stream(1, closefd=False), stream(2, closefd=False)
    forking.forget_server()
    commands.known = plan
    sys.argv = ["snakemake", *words]
    from snakemake.cli import main

    main(words)


def _received(reader: int, writer: int) -> IO[str]:
    """Return the stream of what other processes write to a pipe."""
    os.close(writer)
    return open(reader, encoding="utf-8", errors="replace")


def snakemake_report(directory: Path, name: str, config: Sequence[str], out: Path) -> None:
    """Write Snakemake's own report on the finished experiment `name` below `directory`.

    `config` are the arguments of ``--config``. The report is one HTML file, made without a network.

    Raises
    ------
    UserError
        An output is missing.
    """
    command = [
        *(sys.executable, "-m", "snakemake", "--snakefile", str(CHECKOUT / "Snakefile")),
        *("--cores", "1", "--quiet", "all", "--nolock", "--directory", str(directory)),
        *("--report", str(out.resolve())),
        "--config",
    ]
    with (
        the_only_run(directory, name),
        NamedTemporaryFile("r", encoding="utf-8") as errors,
    ):
        done = subprocess.run([*command, *config, f"errors={errors.name}"], check=False)
        if done.returncode:
            raise UserError(f"{errors.read().strip()}\nRun the whole experiment first")


def _unexplained(errors: str) -> str:
    """Return Snakemake's messages, unless a stage has already said what the user can correct."""
    has_said_why = "StageError" in errors and f"ended with exit code {USER_ERROR}" in errors
    return "" if has_said_why else errors.rstrip()


def _set_aside_damaged(folder: Path) -> None:
    damaged = set_aside_damaged(folder)
    for path in damaged:
        print(f"damaged   {path}: renamed to ….damaged; it will be made again", flush=True)
    if damaged:
        remove_made_from_runs(folder)


def set_aside(directory: Path, name: str) -> None:
    """Set aside the damaged results of experiment `name` below `directory`, before they are read.

    Raises
    ------
    BusyError
    """
    with the_only_run(directory, name):
        _set_aside_damaged(directory / "results" / name)


def _correct_times(folder: Path) -> None:
    """Give files from the future the present time: Snakemake refuses what is older than its input."""
    now = time.time()
    for path in folder.rglob("*"):
        if path.is_file() and path.stat().st_mtime > now:
            os.utime(path, (now, now))


def remove_made_from_runs(folder: Path) -> None:
    """Remove what is made from the runs of an experiment.

    Snakemake makes no missing file again while everything made from it exists.
    """
    for name in ("metrics", "tables", "report"):
        for place in (folder, folder / EVIDENCE):
            shutil.rmtree(place / name, ignore_errors=True)
    shutil.rmtree(folder / "parts", ignore_errors=True)


@contextmanager
def the_only_run(directory: Path, name: str) -> Iterator[IO[str]]:
    """Hold the lock of an experiment's results; it is released with the last process that has it open.

    Raises
    ------
    BusyError
        Another process holds it, or a Snakemake that was started manually uses the results.
    """
    folder = directory / "results" / name
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "run.lock").open("a+", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            holder = lock.read().strip() or "another process"
            raise BusyError(
                f"{folder}: another run uses these results: {holder}; wait for it, or stop it with "
                "`kill` and the first process number"
            ) from None
        if manual := _snakemake_locks(directory, name):
            raise BusyError(
                f"{folder}: a Snakemake that was started manually has locked these results "
                f"({manual[0]}). Wait for it; if it no longer runs, remove its lock with "
                f"`{Path(sys.executable).name} -m snakemake --unlock --directory {directory} "
                f"--config experiment={name}`"
            )
        _write(lock, f"process {os.getpid()}")
        yield lock


def _write(lock: IO[str], holder: str) -> None:
    lock.truncate(0)
    lock.write(f"{holder}, since {provenance.now()}\n")
    lock.flush()


def _snakemake_locks(directory: Path, name: str) -> list[Path]:
    """Return Snakemake's own locks on files of this experiment; `workflows run` leaves none."""
    ours = f"results/{name}/"
    return [
        path
        for path in sorted((directory / ".snakemake" / "locks").glob("*.lock"))
        if any(line.startswith(ours) for line in path.read_text(encoding="utf-8").splitlines())
    ]
