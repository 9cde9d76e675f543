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
_LEAST_SLICE = 8  # minimum number of items that a thread takes at once, if there are many

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


def shrinking_slices(count: int, threads: int) -> list[slice]:
    """Cover `count` items by slices: each half of a thread's share of the rest, at least a few items."""
    slices, begin, least = [], 0, min(_LEAST_SLICE, -(-count // (4 * threads)))
    while begin < count:
        end = min(count, begin + max(least, (count - begin) // (2 * threads)))
        slices.append(slice(begin, end))
        begin = end
    return slices


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
