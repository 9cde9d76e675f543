"""Maximal cliques of a graph in rows of bits, and the heaviest clique of every vertex."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.graphs import set_bit
from baselines.mac.kernels import cliques_from
from dcreg.search import Budget


class HeaviestCliques:
    """The heaviest maximal clique of at least three vertices through every vertex.

    Bron-Kerbosch with Tomita's pivot, one subproblem per vertex among those later in `order`. Each is
    limited to `max_cliques` maximal cliques, since dense graphs have too many.
    """

    def __init__(
        self, rows: np.ndarray, weights: np.ndarray, order: np.ndarray, max_cliques: int
    ) -> None:
        n, words = rows.shape
        self.rows, self.weights, self.order, self.max_cliques = rows, weights, order, max_cliques
        self.cliques = np.zeros((n, words), dtype=np.uint64)  # as bits, for every vertex
        self.heaviest = np.full(n, -np.inf)
        self.n_cliques = 0
        self.n_capped = 0  # starting vertices whose cliques are not all listed

    def run(self, budget: Budget) -> bool:
        """List the cliques; return whether the budget sufficed for all starting vertices."""
        before = np.zeros(self.rows.shape[1], dtype=np.uint64)
        for vertex in self.order:
            count, complete = cliques_from(
                self.rows, self.weights, vertex, before, self.max_cliques, self.cliques,
                self.heaviest,
            )  # fmt: skip
            self.n_cliques += count
            self.n_capped += not complete
            set_bit(before, vertex)
            if budget.is_over:
                return False
        return True

    def distinct(self) -> list[np.ndarray]:
        """Return the distinct cliques, the heaviest first."""
        kept = np.flatnonzero(np.isfinite(self.heaviest))
        kept = kept[np.argsort(-self.heaviest[kept], kind="stable")]
        seen: dict[bytes, np.ndarray] = {}
        for vertex in kept:
            row = self.cliques[vertex]
            bits = np.unpackbits(row.view(np.uint8), bitorder="little")
            seen.setdefault(row.tobytes(), np.flatnonzero(bits))
        return list(seen.values())
