"""The error of what the norm stage of a search decides in 3D."""

from __future__ import annotations

import numpy as np

from dcreg.problem import apply_pose
from workflows.metrics.case import Case, metric


@metric("source unit", "lower", np.inf)
def norm_translation_error(case: Case) -> float:
    """Error of the translation in norm space, independent of the rotation: the distance between the two
    points that the found pose and the reference pose move to the mean of the target; empty in 2D."""
    if case.dim == 2:
        return float("nan")
    centre = case.target.mean(axis=0)[None]
    found, true = (apply_pose(np.linalg.inv(T), centre) for T in (case.T, case.T_true))
    return float(np.linalg.norm(found - true))
