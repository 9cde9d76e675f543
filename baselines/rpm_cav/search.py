"""Simplicial branch and bound over the statistics of a matching."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field

import numpy as np

from baselines._shared.concave import Coordinates, History, OutOfTimeError, Reduced, Support
from baselines._shared.kernels.statistics import N_STATISTICS, least_linear
from baselines.rpm_cav.kernels import bound_children, bound_simplex, values_at
from dcreg.search import Budget
from dcreg.status import Status

_MAX_CORNERS = 256  # corners of the box tried for the root simplex


@dataclass
class Settings:
    """See the card's parameters."""

    gap_tol: float  # in normalised units
    ascents: int
    by_gap: bool


class OpenSimplices:
    """Open simplices in growing arrays, best lower bound first, among equals the older."""

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
        """Memory held, counting about 120 bytes a node for the heap's Python objects."""
        return self._vertices.nbytes + self._values.nbytes + 120 * len(self._heap)

    def push(self, vertices: np.ndarray, values: np.ndarray, bounds: np.ndarray) -> None:
        for node, bound in enumerate(bounds):
            slot = self._free.pop() if self._free else self._new_slot()
            self._vertices[slot], self._values[slot] = vertices[node], values[node]
            heapq.heappush(self._heap, (float(bound), next(self._serial), slot))

    def pop(self, count: int, cutoff: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Up to `count` best simplices whose bound lies below `cutoff`."""
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
class Search:
    """The running search; bounds are in normalised units, the incumbent lives in `reduced`."""

    reduced: Reduced
    settings: Settings
    budget: Budget
    status: Status | None = None
    lower_bound: float = 0.0  # a sum of squares
    n_nodes: int = 0
    n_assignments: int = 0
    dim: int = 0
    raw_bound: float = -np.inf  # before zero was taken for a lower bound
    history: History = field(init=False)

    def __post_init__(self) -> None:
        self.history = History(self.budget, self.reduced.area)

    @property
    def upper_bound(self) -> float:
        return self.reduced.incumbent.value

    @property
    def cutoff(self) -> float:
        return self.upper_bound - self.settings.gap_tol

    def run(self) -> None:
        clouds, incumbent = self.reduced.clouds, self.reduced.incumbent
        self.record()
        support = Support(clouds, incumbent, self.budget)
        try:
            coordinates = support.coordinates()
            self.dim = coordinates.dim
            root = root_simplex(support, coordinates)
        except OutOfTimeError:
            self.n_assignments += support.n_assignments
            self.finish(Status.TIME_LIMIT)
            return
        self.n_assignments += support.n_assignments
        if self.dim == 0:  # all matchings agree in their statistics: the least L decides
            _, col_of = least_linear(clouds, np.zeros(N_STATISTICS), 1.0)
            incumbent.offer(col_of)
            self.n_assignments += 1
            self.lower_bound = self.upper_bound
            self.finish(Status.OPTIMAL)
            return
        self._branch(coordinates, root)

    def _branch(self, z: Coordinates, root: np.ndarray) -> None:
        clouds = self.reduced.clouds
        nodes = OpenSimplices(self.dim)
        col_of = np.empty(len(clouds.source), np.int64)
        values = values_at(clouds, z.origin, z.axes, root)
        bound, value, spent = bound_simplex(
            clouds, z.origin, z.inverse, root, values, self.cutoff, self.settings.ascents, col_of
        )
        self._account(1, spent, value, col_of)
        nodes.push(root[None], values[None], np.array([bound]))
        round_size = int(np.clip(200_000 // (len(clouds.source) * len(clouds.target)), 1, 16))
        pruned = np.inf
        while self.status is None:
            self.raw_bound = min(nodes.lower_bound, pruned, self.upper_bound)
            self.lower_bound = max(self.lower_bound, self.raw_bound)
            self.record()
            self.status = self._ended(nodes)
            if self.status is not None:
                break
            found = nodes.pop(round_size, self.cutoff)
            vertices, values, bounds, value, spent = bound_children(
                clouds, z.origin, z.axes, z.inverse, *found, self.cutoff,
                self.settings.ascents, self.settings.by_gap, col_of,
            )  # fmt: skip
            self._account(len(bounds), spent, value, col_of)
            keep = bounds < self.cutoff
            if not keep.all():
                pruned = min(pruned, float(bounds[~keep].min()))
            nodes.push(vertices[keep], values[keep], bounds[keep])
        self.record()

    def _ended(self, nodes: OpenSimplices) -> Status | None:
        budget = self.budget
        if self.lower_bound >= self.cutoff:
            return Status.OPTIMAL
        if self.budget.is_over:
            return Status.TIME_LIMIT
        if budget.nodes is not None and self.n_nodes >= budget.nodes:
            return Status.NODE_LIMIT
        # half of the worker's memory: the rest is Python and its libraries
        if budget.memory_mb is not None and nodes.nbytes > 0.5 * budget.memory_mb * 2**20:
            return Status.MEMORY_LIMIT
        return None

    def _account(self, nodes: int, spent: int, value: float, col_of: np.ndarray) -> None:
        self.n_nodes += nodes
        self.n_assignments += spent
        if self.reduced.incumbent.beaten_by(value):
            self.reduced.incumbent.offer(col_of)

    def record(self) -> None:
        self.history.add(
            self.lower_bound,
            self.upper_bound,
            self.n_nodes,
            self.n_assignments + self.reduced.incumbent.n_assignments,
            last=self.status is not None,
        )

    def finish(self, status: Status) -> None:
        self.status = status
        self.record()


def root_simplex(support: Support, z: Coordinates) -> np.ndarray:
    """A simplex that holds z of every matching, its vertices as rows.

    At a corner of the unit box, cut off by the farthest matching in the direction of the opposite
    corner (one assignment); of all corners the one with the smallest simplex.
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
