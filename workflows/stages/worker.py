"""The process in which a method runs. It receives instances through a pipe, never the ground truth.

``python -m workflows.stages.worker FD`` answers requests on the inherited connection FD until it closes.
Every request is answered with a dict, or the process dies; the parent (`sandbox`) handles both. The
answer may be preceded by `COMPILING`: code is compiled within the request, so its time is not valid; and
by numbers: the share that a search has proven.
"""

from __future__ import annotations

import ctypes
import faulthandler
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.status import Status

MAX_TRACE = 500  # events kept of one run
COUNTERS = ("n_nodes", "n_assignments")
MB = 2**20
COMPILING = "compiling"
REPORT_S = 1.0  # between two reports of a search
CROSSED = 1e-6  # relative rounding of two bounds that meet
# A method that exceeds its limit by this factor had an advantage over those that keep it.
LATE = 1.1


class Server:
    """Answers the parent's requests for one method.

    `notify` sends the parent a message before the answer: `COMPILING`, or the share that is proven.
    """

    method: Baseline

    def __init__(self, notify: Callable[[str | float], None]) -> None:
        self.notify = notify
        self._reported_at = 0.0

    def open(self, baseline: str, options: dict[str, Any], threads: int) -> dict[str, Any]:
        """Import and configure the method; ``reason`` explains why it cannot run here."""
        from baselines import registry

        self.threads = threads
        self.method = registry.load(baseline, **options)
        reason = self.method.available()
        _cap_threads(threads)
        return {"reason": reason}

    def warm_up(self, instance: Instance, memory_mb: int) -> dict[str, Any]:
        """Compile and import what instances of this kind need, outside of the timed runs."""
        if self.method.supports(instance) is None:
            with _compiling_soon():
                self.method.warm_up(instance)
        _cap_threads(self.threads)  # also for libraries that the warm-up loaded
        _cap_memory(memory_mb)
        return {}

    def solve(self, instance: Instance, limits: Limits) -> dict[str, Any]:
        """Solve one instance; every exception becomes a status.

        Other processes may have used the memory that a method lacks, so the parent repeats such a run
        (`exhausted`) in a new process.
        """
        if reason := self.method.supports(instance):
            return {"status": Status.UNSUPPORTED, "message": reason}
        self._observe_searches()
        _reset_peak()
        start = time.perf_counter()
        try:
            with _when_compiling(lambda: self.notify(COMPILING)):
                solution = self.method.solve(instance, limits)
            time_solve_s = time.perf_counter() - start
            answer = _in_time(_checked(solution, instance.dim), time_solve_s, limits.time_s)
        except MemoryError as error:
            time_solve_s = time.perf_counter() - start
            message = f"MemoryError: {error}; the limit is {limits.memory_mb} MB"
            answer = {"status": Status.FAILED, "message": message, "exhausted": True}
        except Exception as error:
            time_solve_s = time.perf_counter() - start
            traceback.print_exc()
            answer = {"status": Status.FAILED, "message": _described(error)}
        return {**answer, "time_solve_s": time_solve_s, "peak_memory_mb": _peak_memory_mb()}

    def _observe_searches(self) -> None:
        """Report the searches of the library, and of methods that use its budget, once a second.

        It does nothing in a process that has not loaded the budget by the end of its warm-up.
        """
        if module := sys.modules.get("dcreg.search.budget"):
            module.Budget.observer = self._report

    def _report(self, event: Any) -> None:
        now = time.monotonic()
        if now - self._reported_at >= REPORT_S:
            self._reported_at = now
            self.notify(float(event.bound_ratio))


def serve(connection: Connection) -> None:
    """Answer requests ``(command, arguments)`` until the parent closes the connection."""
    lock = threading.Lock()  # searches report from a thread of their own

    def send(message: Any) -> None:
        with lock:
            connection.send(message)

    server = Server(send)
    while True:
        try:
            command, arguments = connection.recv()
        except EOFError:
            return
        start = time.perf_counter()
        try:
            answer = getattr(server, command)(*arguments)
        except Exception as error:
            traceback.print_exc()
            answer = {"error": _described(error)}
        send({"time_s": time.perf_counter() - start, **answer})


def _checked(solution: Solution, dim: int) -> dict[str, Any]:
    """Return a solution as plain values; one without a usable pose counts as failed."""
    status, message, pose = Status(solution.status), solution.message, solution.T_target_source
    if status in (Status.UNSUPPORTED, Status.UNAVAILABLE):
        return {"status": status, "message": message}
    if status is not Status.FAILED:
        shape = (dim + 1, dim + 1)
        if pose is None:
            message, status = f"returned {status} without a pose", Status.FAILED
        elif np.shape(pose) != shape:
            message, status = (
                f"returned a pose of shape {np.shape(pose)}, not {shape}",
                Status.FAILED,
            )
        elif not np.isfinite(pose).all():
            message, status = "returned a pose that is not finite", Status.FAILED
        elif _is_crossed(solution):
            bounds = f"{solution.lower_bound:.6g} above the upper bound {solution.upper_bound:.6g}"
            message, status = f"returned the lower bound {bounds}", Status.FAILED
    if status is Status.FAILED:
        pose = None
    return {
        "status": status,
        "message": message,
        "T_target_source": None if pose is None else np.asarray(pose, dtype=float).tolist(),
        "lower_bound": solution.lower_bound,
        "upper_bound": solution.upper_bound,
        "gap_tol": solution.gap_tol,
        "certificate_scope": solution.certificate_scope,
        **{name: solution.counters.get(name) for name in COUNTERS},
        "extra": dict(solution.extra),
        "trace": _thinned(solution.trace),
    }


def _is_crossed(solution: Solution) -> bool:
    """Whether the bounds contradict each other by more than rounding."""
    lower, upper = solution.lower_bound, solution.upper_bound
    if lower is None or upper is None:
        return False
    return bool(lower > upper + CROSSED * (1.0 + abs(upper)))


def _in_time(answer: dict[str, Any], time_s: float, limit_s: float) -> dict[str, Any]:
    """Mark the answer of a method that exceeded the time limit as limited."""
    if answer["status"] not in (Status.OPTIMAL, Status.CONVERGED) or time_s <= LATE * limit_s:
        return answer
    message = f"returned after {time_s:.3g} s; the limit is {limit_s:g} s"
    both = "; ".join(filter(None, (answer["message"], message)))
    return {**answer, "status": Status.TIME_LIMIT, "message": both}


def _compiling_soon() -> AbstractContextManager[None]:
    """Return a context in which kernels are compiled in less time; without kernels, it does nothing."""
    jit = sys.modules.get("dcreg.jit")
    return jit.when_compiling(lambda: None) if jit else nullcontext()


def _when_compiling(notify: Callable[[], None]) -> AbstractContextManager[None]:
    """Return a context that calls `notify` once, before Numba first compiles (not: loads) a function.

    It does nothing in a process that has not loaded Numba by the end of its warm-up.
    """
    if "numba" not in sys.modules:
        return nullcontext()
    from numba.core import event

    class Listener(event.Listener):
        notified = False

        def on_start(self, event: Any) -> None:
            if not self.notified:
                self.notified = True
                notify()

        def on_end(self, event: Any) -> None:
            pass

    return event.install_listener("numba:compile", Listener())


def _thinned(events: list[Any]) -> list[Any]:
    """Return at most `MAX_TRACE` events, evenly spaced, with the first and the last."""
    if len(events) <= MAX_TRACE:
        return events
    kept = np.unique(np.linspace(0, len(events) - 1, MAX_TRACE).round().astype(int))
    return [events[index] for index in kept]


def _described(error: Exception) -> str:
    """Return type, text and innermost line of an error, without escape codes."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = "".join(c if c.isprintable() or c == "\n" else "?" for c in str(error))
    return f"{type(error).__name__}: {text}{where}"


def _cap_threads(threads: int) -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(threads)


def _cap_memory(memory_mb: int) -> None:
    """Cap huge allocations, which the parent would notice too late.

    The cap is well above the limit, as libraries reserve more than they use.
    """
    import resource

    with suppress(OSError, ValueError):
        used = _proc_status("VmData") or 0
        ceiling = int((used + 2 * memory_mb) * MB)
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (ceiling, hard))


def _reset_peak() -> None:
    """Reset the kernel's record of the peak, if possible (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_memory_mb() -> float:
    """Return the maximum resident memory since `_reset_peak`, or since the start of the process."""
    import resource

    return _proc_status("VmHWM") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _proc_status(field: str) -> float | None:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{field}:"):
                return int(line.split()[1]) / 1024
    return None


def _die_with_parent() -> None:
    """End this process when its parent is killed (Linux)."""
    with suppress(OSError, AttributeError):
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    faulthandler.enable()
    _die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    serve(Connection(int(sys.argv[1])))
