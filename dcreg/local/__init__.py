"""Local steps at a pose: matching, least-squares fit, polish."""

from dcreg.local.assignment import k_assignment, pairs_of
from dcreg.local.fit import fit_pose
from dcreg.local.polish import follow_nearest, is_hurried, objective, polish
from dcreg.local.reuse import Matched, quick_objective

__all__ = [
    "Matched",
    "fit_pose",
    "follow_nearest",
    "is_hurried",
    "k_assignment",
    "objective",
    "pairs_of",
    "polish",
    "quick_objective",
]
