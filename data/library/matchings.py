"""The optimum of a tiny problem by all matchings."""

from __future__ import annotations

from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from data.library.problem import Problem
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose

SAME_VALUE = 1e-9  # relative
SAME_POSE = 1e-6  # displacement of a source point, in the unit of the problem


class Enumerated(NamedTuple):
    """The optimum over all matchings, each with its best pose in closed form."""

    optimum: float
    pose: np.ndarray
    n_optima: int  # distinct poses with this objective
    n_matchings: int


def best_of_all_matchings(problem: Problem) -> Enumerated:
    """Try all matchings of a problem with a few points."""
    source, target = problem.clouds
    fits = []
    for rows in map(list, combinations(range(len(source)), problem.n_inliers)):
        for columns in map(list, permutations(range(len(target)), problem.n_inliers)):
            x, y = source[rows], target[columns]
            pose = fit_pose(x, y, problem.scale_range)
            fits.append((float(((apply_pose(pose, x) - y) ** 2).sum()), pose))
    optimum, best = min(fits, key=lambda fit: fit[0])
    distinct: list[np.ndarray] = []
    for value, pose in fits:
        if value <= optimum * (1 + SAME_VALUE):
            moved = apply_pose(pose, source)
            if all(np.abs(moved - other).max() > SAME_POSE for other in distinct):
                distinct.append(moved)
    return Enumerated(optimum, best, len(distinct), len(fits))
