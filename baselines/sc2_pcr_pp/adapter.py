"""SC²-PCR++, a port: poses of SC²-PCR, chosen by a truncated Chamfer distance over candidates."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines._shared.kernels.lengths import consistency_graph
from baselines._shared.kernels.samples import count_within
from baselines._shared.robust import squared_residuals
from baselines.contract import Instance
from baselines.sc2_pcr.consensus import choose_seeds, refine, seed_pose
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Seeds, two-stage consensus sets, and the refined pose with the best score over candidates."""

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        source, target = instance.source[pairs[:, 0]], instance.target[pairs[:, 1]]
        bound = self.inlier_distance(instance)
        rows = consistency_graph(source, target, pairs, bound, 1.0)
        most_seeds = max(1, round(self.options["seed_ratio"] * len(pairs)))
        seeds = choose_seeds(source, target, bound, most_seeds)
        sizes = self.options["first_neighbours"], self.options["second_neighbours"]
        poses: list[tuple[int, np.ndarray]] = []  # with their numbers of inliers
        for seed in seeds:
            if (pose := seed_pose(source, target, rows, seed, sizes)) is not None:
                poses.append((int(count_within(source, target, pose, bound)), pose))
            if budget.is_over:
                break
        poses.sort(key=lambda counted: -counted[0])
        best, most = None, 0.0
        for _, pose in poses[: self.options["refined"]]:
            pose = refine(pose, source, target, bound)
            closeness = candidate_closeness(pose, source, target, pairs[:, 0], bound)
            if closeness > most:
                best, most = pose, closeness
            if budget.is_over:
                break
        return Estimate(best, not budget.is_over, extra={"seeds": float(len(seeds))})


def candidate_closeness(
    pose: np.ndarray, source: np.ndarray, target: np.ndarray, point: np.ndarray, bound: float
) -> float:
    """Sum ``max(0, 1 - d / bound)`` over source points, with d to their nearest candidate.

    Row i pairs the source point of index ``point[i]`` with one of its candidates.
    """
    distances = np.sqrt(squared_residuals(pose, source, target))
    best = np.zeros(point.max() + 1)
    np.maximum.at(best, point, 1 - distances / bound)
    return float(best.sum())
