"""MAC, registration with maximal cliques, a port of the published algorithm."""

from __future__ import annotations

import numpy as np

from baselines._shared.cliques import pack
from baselines._shared.consistency import length_differences, sharing, vote_scale
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.poses import median_spacing
from baselines._shared.robust import squared_residuals
from baselines.contract import Instance
from baselines.mac.enumerate import HeaviestCliques
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

SHARE_FOR_GRAPH, SHARE_FOR_CLIQUES = 0.5, 0.8  # of the whole time
ROWS = 64  # of the graph between two checks of the budget


class Adapter(CorrespondenceMethod):
    """Poses of the heaviest maximal clique of every correspondence; the one with minimum error."""

    def idle_options(self) -> dict[str, str]:
        idle = super().idle_options()
        if self.options["compatibility_width"] is None:
            idle["compatibility_threshold"] = "without a compatibility_width"
        return idle

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        for_graph, for_cliques = (
            budget.sub_budget(SHARE_FOR_GRAPH),
            budget.sub_budget(SHARE_FOR_CLIQUES),
        )
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.inlier_distance(instance)
        scale = vote_scale(source, target, 2 * bound, instance.scale_range)
        first = compatibility(
            scale * source, target, pairs, 2 * bound,
            self.options["compatibility_width"], self.options["compatibility_threshold"],
        )  # fmt: skip
        weights = second_order_graph(first, for_graph)
        order = np.argsort(-weights.sum(axis=1), kind="stable")
        search = HeaviestCliques(pack(weights > 0), weights, order, self.options["max_cliques"])
        listed = search.run(for_cliques)
        best, least, judged = None, np.inf, True
        for members in search.distinct():
            pose = fit_pose(source[members], target[members], (scale, scale))
            r2 = squared_residuals(pose, source, target)
            error = float(np.minimum(np.sqrt(r2) / bound, 1.0).sum())
            if error < least:
                best, least = pose, error
            if budget.is_over:
                judged = False
                break
        message = f"{search.n_cliques} maximal cliques"
        if search.n_capped:
            message += f", {search.n_capped} starts capped at {self.options['max_cliques']}"
        return Estimate(best, listed and judged, message, {"maximal_cliques": search.n_cliques})


def compatibility(
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    tolerance: float,
    width: float | None,
    threshold: float,
) -> np.ndarray:
    """Return the compatibility of correspondences in lengths; 0 for those that share a point.

    With a `width`, as published: ``exp(-difference^2 / (2 width^2))`` in median spacings of the
    target, 0 below the `threshold`. Without, for clouds with known noise: ``1 - (difference /
    tolerance)^2``.
    """
    squares = length_differences(source, target) ** 2
    if width is None:
        first = np.maximum(0.0, 1 - squares / tolerance**2)
    else:
        reach = width * median_spacing(target)
        first = np.exp(-squares / (2 * reach**2))
        first[first < threshold] = 0.0
    first[sharing(pairs)] = 0.0  # with the diagonal
    return first


def second_order_graph(first: np.ndarray, budget: Budget) -> np.ndarray:
    """Return the edge weights: compatibility times that of the shared neighbours.

    Edges that are not reached within the budget keep the compatibility as their weight.
    """
    weights = first.copy()
    for start in range(0, len(first), ROWS):
        rows = slice(start, start + ROWS)
        weights[rows] = first[rows] * (first[rows] @ first)
        if budget.is_over:
            break
    return np.minimum(weights, weights.T)
