"""What is known at the vertices of the boxes met so far, shared by all boxes that have them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.families.dc.kernels.lattice import Lattice, find_or_add, rebuild
from dcreg.families.similarity2d.kernels.profiles import Vertices
from dcreg.search import Box

# A cache beyond this forgets the half not met for longest: bounds stay valid, some vertices are solved
# twice.
MAX_CACHE_BYTES = 400 * 2**20
_FIRST = 4096  # vertices there is room for at first


class VertexCache:
    """Vertices by slot, found by their place on a lattice over the hull of the roots.

    Its arrays are those of `dcreg.families.dc.kernels.lattice.Lattice` and
    `dcreg.families.similarity2d.kernels.profiles.Vertices`.

    Parameters
    ----------
    roots : sequence of Box
        Every box asked for is made from one of them by bisection.
    profile_size, duals_size : int
        Entries of a profile and of a dual vector; 0 where none is needed.
    """

    _ARRAYS = ("keys", "thetas", "lows", "values", "levels", "profiles", "duals", "met")

    def __init__(self, roots: Sequence[Box], profile_size: int, duals_size: int) -> None:
        self.origin = np.min([root.lower for root in roots], axis=0)
        self.width = np.max([root.upper for root in roots], axis=0) - self.origin
        self.max_vertices = MAX_CACHE_BYTES // (8 * (profile_size + duals_size + 16))
        self.used = self._calls = 0
        self.keys = np.empty((_FIRST, 4), np.int64)
        self.met = np.empty(_FIRST, np.int64)  # the last call that asked for it
        self.thetas = np.empty((_FIRST, self.origin.size))
        self.lows, self.values, self.levels = (np.empty(_FIRST) for _ in range(3))
        self.profiles, self.duals = (
            np.empty((_FIRST, size)) for size in (profile_size, duals_size)
        )
        self.table = np.full(4 * _FIRST, -1, np.int64)

    @property
    def vertices(self) -> Vertices:
        """What the kernels take; to be asked for anew after each `find`, which may move the arrays."""
        return Vertices(self.thetas, self.lows, self.values, self.levels, self.profiles, self.duals)

    def _reserve(self, count: int) -> None:
        if self.used + count > self.max_vertices:
            self._forget()
        needed = self.used + count
        if needed > len(self.keys):
            # room for all at once: pages never written take no memory, copying again takes time
            for name in self._ARRAYS:
                old = getattr(self, name)
                new = np.empty((max(needed, self.max_vertices), *old.shape[1:]), old.dtype)
                new[: self.used] = old[: self.used]
                setattr(self, name, new)
        if 2 * needed > len(self.table):
            self.table = np.empty(8 * 2 ** int(needed).bit_length(), np.int64)
            rebuild(self.table, self.keys, self.used)

    def _forget(self) -> None:
        """Keep the half of the vertices that was met last."""
        keep = np.sort(np.argsort(self.met[: self.used], kind="stable")[self.used // 2 :])
        for name in self._ARRAYS:
            array = getattr(self, name)
            array[: keep.size] = array[keep]
        self.used = keep.size
        rebuild(self.table, self.keys, self.used)

    def find(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, int]:
        """Slots of the boxes' vertices (-1 beyond the last), and the first slot that is new."""
        slots = np.full((len(lower), 2**self.origin.size), -1, np.int64)
        self._reserve(slots.size)
        self._calls += 1
        before = self.used
        lattice = Lattice(self.table, self.keys, self.thetas, self.met, self.origin, self.width)
        self.used = find_or_add(lattice, before, self._calls, lower, upper, slots)
        self.values[before : self.used] = np.inf
        return slots, before
