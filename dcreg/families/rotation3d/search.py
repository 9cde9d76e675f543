"""The rotation search that follows a search over translations."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.objective import is_large
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.sampled import search_sampled_rotation
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Budget, Outcome, Tolerance, minimise


def search_rotation(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None,
    *,
    tolerance: Tolerance,
    threads: int,
    budget: Budget,
) -> Outcome:
    """Find the best rotation about the origin; for large clouds from a sample.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
        The translation is already applied to the source; the clouds are not centred.
    n_inliers : int
    candidates : (n, m) bool array or None
        The feasible pairs; None: all.
    tolerance : Tolerance
    threads : int
    budget : Budget
    """
    if candidates is None and is_large(len(source), len(target)):
        return search_sampled_rotation(
            source, target, n_inliers, tolerance=tolerance, budget=budget
        )
    space = Rotation3D(source, target, n_inliers, candidates, budget.stop)
    return minimise(
        space, RotationBound(space, threads=threads), budget.named("start of rotation"),
        tolerance=tolerance, stage="rotation",
    )  # fmt: skip
