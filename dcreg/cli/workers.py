"""Processes that solve the pairs of a batch; one that crashes costs only its pair."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait

from dcreg.cli.pair import Row, Task, failed, solve
from dcreg.names import COMPILING

_GLANCE_S = 0.2  # between two checks for a signal
# Not forked: a fork of a process with threads can hang.
_CONTEXT = multiprocessing.get_context("spawn")


def solve_all(
    tasks: Iterable[Task], jobs: int, is_stopped: Callable[[], bool], *, quiet: bool = True
) -> Iterator[tuple[Task, Row]]:
    """Solve pairs in `jobs` processes; yield each result when it is ready.

    The processes end with the generator, also if `is_stopped` ends it early. Unless `quiet`, the first
    one prints when it compiles.
    """
    waiting = deque(tasks)
    idle: list[_Worker] = []
    busy: dict[object, _Worker] = {}
    try:
        while (waiting or busy) and not is_stopped():
            while waiting and len(busy) < jobs:
                worker = idle.pop() if idle else _Worker(quiet or bool(busy))
                worker.give(waiting.popleft())
                busy[worker.connection] = worker
            for connection in wait([worker.connection for worker in busy.values()], _GLANCE_S):
                worker = busy.pop(connection)
                row = worker.receive()
                if worker.process.is_alive():
                    idle.append(worker)
                yield worker.task, row
    finally:
        for worker in [*idle, *busy.values()]:
            worker.end()


class _Worker:
    """A process that solves one pair after the other."""

    task: Task

    def __init__(self, quiet: bool) -> None:
        self.connection, other = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_serve, args=(other, quiet), daemon=True)
        self.process.start()
        other.close()  # so that the end of the process is the end of the connection

    def give(self, task: Task) -> None:
        self.task = task
        with suppress(BrokenPipeError):  # `receive` reports it
            self.connection.send(task)

    def receive(self) -> Row:
        try:
            row: Row = self.connection.recv()
        except (EOFError, ConnectionError):
            self.process.join()
            code = self.process.exitcode or 0
            return failed(
                f"the process ended with {f'signal {-code}' if code < 0 else f'code {code}'}"
            )
        return row

    def end(self) -> None:
        self.process.terminate()
        self.process.join()
        self.connection.close()


def _serve(connection: Connection, quiet: bool) -> None:
    """Solve what comes; the process that sends it decides about Ctrl-C."""
    if not quiet:
        print_when_compiling()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError):
        while True:
            connection.send(solve(connection.recv()))


def print_when_compiling() -> None:
    """Print when kernels are compiled, because the first pairs then take long."""
    handler, library = logging.StreamHandler(), logging.getLogger("dcreg")
    handler.addFilter(lambda record: record.msg == COMPILING)
    library.addHandler(handler)
    library.setLevel(logging.INFO)


def _end_with_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
    os._exit(1)
