"""MAC, registration with maximal cliques, own port."""

from __future__ import annotations

import time

import numpy as np

from baselines._shared.cliques import pack
from baselines._shared.consistency import length_differences, sharing, vote_scale
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.robust import squared_residuals
from baselines.contract import Instance, Limits
from baselines.mac.enumerate import HeaviestCliques
from dcreg.local import fit_pose

SHARE_FOR_GRAPH, SHARE_FOR_CLIQUES = 0.5, 0.8  # of the time; the rest judges hypotheses
ROWS = 64  # of the graph between two looks at the clock


class Adapter(CorrespondenceMethod):
    """A pose from every correspondence's heaviest maximal clique; the one of least error."""

    def estimate(self, instance: Instance, pairs: np.ndarray, limits: Limits) -> Estimate:
        start = time.perf_counter()
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.options["noise_factor"] * instance.noise_bound
        scale = vote_scale(source, target, 2 * bound, instance.scale_range)
        weights = second_order_graph(
            scale * source, target, pairs, 2 * bound, start + SHARE_FOR_GRAPH * limits.time_s
        )
        order = np.argsort(-weights.sum(axis=1), kind="stable")
        search = HeaviestCliques(pack(weights > 0), weights, order, self.options["max_cliques"])
        listed = search.run(start + SHARE_FOR_CLIQUES * limits.time_s)
        best, least, judged = None, np.inf, True
        for members in search.distinct():
            pose = fit_pose(source[members], target[members], (scale, scale))
            r2 = squared_residuals(pose, source, target)
            error = float(np.minimum(np.sqrt(r2) / bound, 1.0).sum())
            if error < least:
                best, least = pose, error
            if time.perf_counter() > start + limits.time_s:
                judged = False
                break
        message = f"{search.n_cliques} maximal cliques"
        if search.n_capped:
            message += f", {search.n_capped} starts capped at {self.options['max_cliques']}"
        return Estimate(best, listed and judged, message, {"maximal_cliques": search.n_cliques})


def second_order_graph(
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    tolerance: float,
    deadline: float = np.inf,
) -> np.ndarray:
    """Weights of the graph: compatibility times that of the neighbours two pairs share.

    Edges not reached by the deadline keep the compatibility alone as their weight.
    """
    first = np.maximum(0.0, 1 - (length_differences(source, target) / tolerance) ** 2)
    first[sharing(pairs)] = 0.0  # with the diagonal
    weights = first.copy()
    for start in range(0, len(first), ROWS):
        rows = slice(start, start + ROWS)
        weights[rows] = first[rows] * (first[rows] @ first)
        if time.perf_counter() > deadline:
            break
    return np.minimum(weights, weights.T)
