"""Run a method in a worker process whose loss costs one run only.

The worker solves many instances, so that imports and JIT compilation are needed once. It is killed, with
all its children, at the hard time limit or the memory limit, and replaced for the next instance; a crash
shows as the end of the pipe. In each case one run ends as `failed`; after a crash, or if memory ran out
below the limit, only if a second try ends in the same way. A run in which code was compiled is repeated.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import psutil

from baselines.contract import Instance
from dcreg.status import Status
from workflows.config import LimitSettings, MethodSettings
from workflows.stages import isolation
from workflows.stages.worker import COMPILING

WATCH_S = 0.05  # between two measurements of a busy worker's memory
FAMILY_S = 1.0  # between two lists of its child processes
MAX_REPEATS = 5  # of a run that compiled code; then it counts in any case
MB = 2**20
UNPROTECTED = b"warning: this system has no Landlock, so the method can read the ground truth\n"


class WorkerLostError(Exception):
    """The worker was killed at a limit; the message gives the reason."""


class WorkerDiedError(WorkerLostError):
    """The worker ended by itself, was killed from outside or ran out of memory: another try may succeed.

    Attributes
    ----------
    answer : dict
        Of a worker that ran out of memory; else empty.
    """

    def __init__(self, message: str, answer: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.answer = answer or {}


class Worker:
    """One worker process and the pipe to it.

    While the worker is busy, `watch` is called, with the proven share of its search if that has changed.
    """

    def __init__(
        self,
        threads: int,
        memory_mb: int,
        log: Path,
        watch: Callable[[float | None], None] = lambda proven: None,
    ) -> None:
        self.memory_mb, self.watch = memory_mb, watch
        self._log, self._logged_before = log, 0  # the log, and its size before the last request
        self.compiled = False  # whether code was compiled within the last request
        self._alive = True
        self._family: list[psutil.Process] = []
        self._family_until = 0.0
        self.connection, far_end = Pipe()
        self._folder = TemporaryDirectory(prefix="dcreg-worker-", ignore_cleanup_errors=True)
        rules = isolation.ruleset(isolation.hidden_folders())
        with far_end, log.open("ab") as stream:
            passed = [far_end.fileno(), *([] if rules is None else [rules])]
            if rules is None:
                stream.write(UNPROTECTED)
            self.process = subprocess.Popen(
                [sys.executable, "-m", "workflows.stages.isolation", *map(str, passed)],
                pass_fds=passed,
                env=isolation.environment(os.environ, threads, Path(self._folder.name)),
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                start_new_session=True,  # its own group, so that its children die with it
            )
        if rules is not None:
            os.close(rules)

    def ask(
        self,
        command: str,
        *arguments: Any,
        timeout_s: float,
        limit: str,
        compile_s: float = 0.0,
    ) -> dict[str, Any]:
        """Return the worker's answer within `timeout_s`, plus `compile_s` if it compiles.

        Raises
        ------
        WorkerLostError
            At the time or memory limit. The worker cannot be used any more.
        WorkerDiedError
        """
        self.compiled = False
        self._logged_before = self._log.stat().st_size
        try:
            self.connection.send((command, arguments))
            answer = self._received(timeout_s, limit)
            if answer == COMPILING:
                self.compiled = True
                answer = self._received(timeout_s + compile_s, f"{limit}, and it compiled code")
            return answer
        except (EOFError, OSError) as error:
            self.kill(patience_s=2.0)  # let it exit by itself to get its exit code
            raise WorkerDiedError(f"worker {self._end()}") from error

    def _received(self, timeout_s: float, limit: str) -> Any:
        """Return the worker's next answer; until then, watch its time and memory."""
        deadline = time.monotonic() + timeout_s
        while isinstance(answer := self._next(deadline, timeout_s, limit), float):
            self.watch(answer)
        return answer

    def _next(self, deadline: float, timeout_s: float, limit: str) -> Any:
        """Return the worker's next message."""
        while not self.connection.poll(max(0.0, min(WATCH_S, deadline - time.monotonic()))):
            used_mb = self._memory_mb()
            if used_mb > self.memory_mb:
                self.kill()
                raise WorkerLostError(
                    f"killed at {used_mb:.0f} MB; the limit is {self.memory_mb} MB"
                )
            if time.monotonic() >= deadline:
                was_stopped, lacked_memory = self._is_stopped(), self._lacked_memory()
                self.kill()
                if was_stopped:
                    raise WorkerDiedError("worker was stopped from outside")
                if lacked_memory:
                    raise WorkerDiedError("worker got no memory and waited for ever")
                raise WorkerLostError(f"killed after {timeout_s:.1f} s without an answer; {limit}")
            self.watch(None)
        return self.connection.recv()

    def kill(self, patience_s: float = 0.0) -> None:
        """End the worker and all its children, after `patience_s` in which it may exit by itself."""
        if not self._alive:
            return
        self._alive = False
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=patience_s)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.connection.close()
        self._folder.cleanup()

    def close(self) -> None:
        """Close the pipe and end the worker."""
        self.connection.close()
        self.kill(patience_s=2.0)

    def _memory_mb(self) -> float:
        """Return the resident memory of the worker and its children."""
        total = 0
        if time.monotonic() > self._family_until:  # listing children reads all of /proc
            self._family_until = time.monotonic() + FAMILY_S
            with suppress(psutil.Error):
                worker = psutil.Process(self.process.pid)
                self._family = [worker, *worker.children(recursive=True)]
        for process in self._family:
            with suppress(psutil.Error):
                total += process.memory_info().rss
        return total / MB

    def _lacked_memory(self) -> bool:
        """Whether the log of this request has an error of memory, as of a thread that could not start."""
        with self._log.open("rb") as stream:
            stream.seek(self._logged_before)
            return b"MemoryError" in stream.read()

    def _is_stopped(self) -> bool:
        """Tell whether a signal such as SIGSTOP has suspended the worker."""
        with suppress(psutil.Error):
            return psutil.Process(self.process.pid).status() == psutil.STATUS_STOPPED
        return False

    def _end(self) -> str:
        code = self.process.returncode
        if code is not None and code < 0:
            return f"died of {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


class Sandbox:
    """A method that solves one instance after the other, whatever happens to its worker."""

    def __init__(
        self,
        method: MethodSettings,
        limits: LimitSettings,
        log: Path,
        watch: Callable[[float | None], None] = lambda proven: None,
    ) -> None:
        self.method = method
        self.limits = limits
        self.log = log
        self.watch = watch  # as of `Worker`
        # Time to start and compile of the present worker, and the sum over all workers.
        self.time_warmup_s = float("nan")
        self.time_started_s = 0.0
        self._worker: Worker | None = None
        # The result of all runs if the method cannot run here.
        self._verdict: tuple[Status, str] | None = None
        self._warm_up = True
        self._since = 0.0  # start of the present run

    def __enter__(self) -> Sandbox:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        if self._worker and kind is None:
            self._worker.close()
        elif self._worker:  # interrupted: do not wait for its answer
            self._worker.kill()

    def prepare(self, instance: Instance) -> None:
        """Start a worker that has imported and compiled what instances of this kind need.

        Raises
        ------
        WorkerLostError
            If the worker was lost meanwhile.
        """
        if self._worker or self._verdict:
            return
        start = time.perf_counter()
        try:
            self._worker = self._started(instance)
        finally:
            self.time_warmup_s = time.perf_counter() - start
            self.time_started_s += self.time_warmup_s

    def _started(self, instance: Instance) -> Worker | None:
        patience: Any = {"timeout_s": self.limits.warm_up_s, "limit": "this was the warm-up"}
        worker = Worker(self.limits.threads, self.limits.memory_mb, self.log, self.watch)
        try:
            method, threads = self.method, self.limits.threads
            answer = worker.ask("open", method.baseline, method.options, threads, **patience)
            if "error" in answer:
                self._verdict = Status.FAILED, answer["error"]
            elif answer["reason"]:
                self._verdict = Status.UNAVAILABLE, answer["reason"]
            elif self._warm_up:
                # An exception in the warm-up is ignored: the run may still succeed. A warm-up that loses
                # the worker is skipped from then on, so that it costs one run only.
                self._warm_up = False
                worker.ask("warm_up", instance, self.limits.memory_mb, **patience)
                self._warm_up = True
        except BaseException:
            worker.kill()
            raise
        if self._verdict:
            worker.close()
            return None
        return worker

    def solve(self, instance: Instance) -> dict[str, Any]:
        """Return the worker's answer or, if it was lost, the status of the run; never raises.

        A run whose worker died or ran out of memory is tried again once.
        """
        try:
            return self._try(instance)
        except WorkerDiedError as first:
            self._log(f"{instance.instance_id}: tried again: {first}")
            try:
                return self._try(instance)
            except WorkerDiedError as second:
                return self._lost(f"{second}, twice") | second.answer

    def _try(self, instance: Instance) -> dict[str, Any]:
        """Return the worker's answer or, if it hit a limit, the status of the run.

        Raises
        ------
        WorkerDiedError
        """
        self._since = time.perf_counter()
        try:
            self.prepare(instance)
            if self._worker is None:
                assert self._verdict is not None
                status, message = self._verdict
                return {"status": status, "message": message}
            answer = self._answer(self._worker, instance)
            if answer.pop("exhausted", False):
                self._worker.kill()
                message = answer.pop("message")
                raise WorkerDiedError(message, {**answer, "time_warmup_s": self.time_warmup_s})
            if "error" in answer:
                answer = {"status": Status.FAILED, "message": answer["error"]}
            return {**answer, "time_warmup_s": self.time_warmup_s}
        except WorkerDiedError:
            self._worker = None
            raise
        except WorkerLostError as loss:
            self._worker = None
            return self._lost(str(loss))

    def _lost(self, message: str) -> dict[str, Any]:
        time_s = time.perf_counter() - self._since
        return {"status": Status.FAILED, "message": message, "time_solve_s": time_s}

    def _answer(self, worker: Worker, instance: Instance) -> dict[str, Any]:
        """Return the answer of the first run in which nothing is compiled."""
        limits = self.limits
        for compile_s in (*[limits.warm_up_s] * MAX_REPEATS, 0.0):
            self._since = time.perf_counter()
            answer = worker.ask(
                "solve",
                instance,
                limits.of_run(),
                timeout_s=limits.kill_after_s,
                limit=f"the limit is {limits.time_s:g} s",
                compile_s=compile_s,
            )
            if not worker.compiled or not compile_s:
                break
            lost = time.perf_counter() - self._since
            self.time_warmup_s += lost
            self.time_started_s += lost
            self._log(f"{instance.instance_id}: repeated, as it compiled code")
        return answer

    def _log(self, line: str) -> None:
        with self.log.open("a") as stream:
            print(line, file=stream)
