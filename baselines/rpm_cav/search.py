"""Simplicial branch and bound over the statistics of a matching."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field

import numpy as np

from baselines._shared.concave import ConcaveSearch, Coordinates, Support
from baselines._shared.cubes import OutOfTimeError
from baselines._shared.kernels.statistics import N_STATISTICS, minimum_linear
from baselines.rpm_cav.kernels import bound_children, bound_simplex, values_at
from dcreg.status import Status

_MAX_CORNERS = 256  # vertices of the box tried for the root simplex


class OpenSimplices:
    """Open simplices in growing arrays, by lower bound, then by age."""

    def __init__(self, dim: int) -> None:
        self._vertices = np.empty((64, dim + 1, dim))
        self._values = np.empty((64, dim + 1))
        self._heap: list[tuple[float, int, int]] = []
        self._free: list[int] = []
        self._used = 0
        self._serial = itertools.count()

    def __len__(self) -> int:
        return len(self._heap)

    @property
    def lower_bound(self) -> float:
        return self._heap[0][0] if self._heap else np.inf

    @property
    def nbytes(self) -> int:
        """Return the memory in use, with about 120 bytes per node for Python objects of the heap."""
        return self._vertices.nbytes + self._values.nbytes + 120 * len(self._heap)

    def push(self, vertices: np.ndarray, values: np.ndarray, bounds: np.ndarray) -> None:
        for node, bound in enumerate(bounds):
            slot = self._free.pop() if self._free else self._new_slot()
            self._vertices[slot], self._values[slot] = vertices[node], values[node]
            heapq.heappush(self._heap, (float(bound), next(self._serial), slot))

    def pop(self, count: int, cutoff: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Remove and return up to `count` best simplices with a bound below `cutoff`."""
        taken: list[tuple[float, int, int]] = []
        while self._heap and len(taken) < count and self._heap[0][0] < cutoff:
            taken.append(heapq.heappop(self._heap))
        slots = [slot for _, _, slot in taken]
        self._free.extend(slots)
        bounds = np.array([bound for bound, _, _ in taken])
        return self._vertices[slots], self._values[slots], bounds

    def _new_slot(self) -> int:
        if self._used == len(self._vertices):
            self._vertices = np.concatenate([self._vertices, np.empty_like(self._vertices)])
            self._values = np.concatenate([self._values, np.empty_like(self._values)])
        self._used += 1
        return self._used - 1


@dataclass
class Search(ConcaveSearch):
    """Best-first search over simplices; the options are those of the card."""

    ascents: int
    by_gap: bool
    raw_bound: float = field(default=-np.inf, init=False)  # without the lower bound zero

    def run(self) -> None:
        clouds, incumbent = self.reduced.clouds, self.reduced.incumbent
        support, is_late = Support(incumbent), False
        try:
            coordinates = support.coordinates()
            self.dim = coordinates.dim
            root = root_simplex(support, coordinates)
        except OutOfTimeError:
            is_late = True
        self.n_assignments += support.n_assignments
        self.record()  # the first incumbent
        if is_late:
            self.status = Status.TIME_LIMIT
        if self.status is None and self.dim == 0:
            # the statistics are equal for all matchings: minimise L
            _, col_of = minimum_linear(clouds, np.zeros(N_STATISTICS), 1.0)
            incumbent.offer(col_of)
            self.n_assignments += 1
            self.lower_bound = self.upper_bound
            self.status = Status.OPTIMAL
        if self.status is None:
            self._branch(coordinates, root)
        self.record()

    def _branch(self, z: Coordinates, root: np.ndarray) -> None:
        clouds = self.reduced.clouds
        nodes = OpenSimplices(self.dim)
        col_of = np.empty(len(clouds.source), np.int64)
        values = values_at(clouds, z.origin, z.axes, root)
        bound, value, spent = bound_simplex(
            clouds, z.origin, z.inverse, root, values, self.cutoff, self.ascents, col_of
        )
        self._account(1, spent, value, col_of)
        nodes.push(root[None], values[None], np.array([bound]))
        round_size = int(np.clip(200_000 // (len(clouds.source) * len(clouds.target)), 1, 16))
        pruned = np.inf
        while self.status is None:
            self.raw_bound = min(nodes.lower_bound, pruned, self.upper_bound)
            self.lower_bound = max(self.lower_bound, self.raw_bound)
            self.record(len(nodes))
            # the other half of the worker's memory is for Python and its libraries
            self.status = self.ended(nodes.nbytes, 0.5)
            if self.status is not None:
                return
            found = nodes.pop(round_size, self.cutoff)
            vertices, values, bounds, value, spent = bound_children(
                clouds, z.origin, z.axes, z.inverse, *found, self.cutoff,
                self.ascents, self.by_gap, col_of,
            )  # fmt: skip
            self._account(len(bounds), spent, value, col_of)
            keep = bounds < self.cutoff
            if not keep.all():
                pruned = min(pruned, float(bounds[~keep].min()))
            nodes.push(vertices[keep], values[keep], bounds[keep])

    def _account(self, nodes: int, spent: int, value: float, col_of: np.ndarray) -> None:
        self.n_nodes += nodes
        self.n_assignments += spent
        if self.reduced.incumbent.beaten_by(value):
            self.reduced.incumbent.offer(col_of)


def root_simplex(support: Support, z: Coordinates) -> np.ndarray:
    """Return the vertices (rows) of a simplex that contains z of every matching.

    The simplex lies at a vertex of the unit box and is cut off by the farthest matching in the direction
    of the opposite vertex (one assignment). The vertex with the smallest simplex is chosen.
    """
    best, reach = np.ones(z.dim), np.inf
    signs = itertools.product((1.0, -1.0), repeat=z.dim)
    for inward in map(np.array, itertools.islice(signs, _MAX_CORNERS)):
        corner = np.where(inward > 0, 0.0, 1.0)
        farthest = support.least(-(inward @ z.inverse))
        size = inward @ (z.inverse @ (farthest - z.origin) - corner)
        if size < reach:
            best, reach = inward, size
    corner = np.where(best > 0, 0.0, 1.0)
    reach *= 1.0 + 1e-9
    return np.vstack([corner, corner + reach * np.diag(best)])
