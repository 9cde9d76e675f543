"""Run independent tasks in threads."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

_GLANCE_S = 0.02

Part = TypeVar("Part")
Done = TypeVar("Done")


def in_threads(work: Callable[[Part], Done], parts: Iterable[Part], threads: int) -> Iterator[Done]:
    """Yield the results of `work` in the order of the parts.

    If the caller stops early, parts that have not begun are cancelled, and the others are awaited.
    """
    if threads == 1:
        yield from map(work, parts)
        return
    pool = ThreadPoolExecutor(threads)
    try:
        yield from pool.map(work, parts)
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def stopped_after(seconds: float, stop: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a stop flag for kernels that is set with `stop`, after some seconds, or at the end."""
    if seconds == np.inf:
        yield stop
        return
    own, ended, began = stop.copy(), threading.Event(), time.monotonic()

    def watch() -> None:
        while not ended.wait(_GLANCE_S):
            own[0] |= stop[0] | (time.monotonic() - began > seconds)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield own
    finally:
        own[0] = 1  # for kernels that still run in threads
        ended.set()
        thread.join()
