"""Independent slices of work, run by a few threads; kernels hold no lock, so they run side by side."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np


class Workers:
    """`threads` threads, the caller's among them.

    Parameters
    ----------
    threads : int
    """

    def __init__(self, threads: int = 1) -> None:
        self._helpers = threads - 1
        self._pool = ThreadPoolExecutor(self._helpers) if threads > 1 else None

    def run(self, work: Callable[[slice], int], count: int) -> int:
        """Sum of what `work` returns over slices that cover `count` items.

        Slices are several times as many as threads and taken as threads become free.
        """
        if self._pool is None or count < 2:
            return work(slice(0, count)) if count else 0
        parts = min(count, 8 * (self._helpers + 1))
        edges = np.linspace(0, count, parts + 1).astype(int)
        # taking the next slice is one step of the interpreter: no two threads get the same
        slices = iter([slice(a, b) for a, b in itertools.pairwise(edges.tolist())])

        def take() -> int:
            return sum(map(work, slices))

        helpers = [self._pool.submit(take) for _ in range(min(self._helpers, parts - 1))]
        done = take()
        return done + sum(helper.result() for helper in helpers)
