"""Local steps at a pose: matching, least-squares fit, polish."""

from dcreg.local.assignment import k_assignment, pairs_of
from dcreg.local.fit import fit_pose
from dcreg.local.polish import AT_ONCE_PAIRS, follow_nearest, objective, polish
from dcreg.local.reuse import Matched, quick_objective

__all__ = [
    "AT_ONCE_PAIRS",
    "Matched",
    "fit_pose",
    "follow_nearest",
    "k_assignment",
    "objective",
    "pairs_of",
    "polish",
    "quick_objective",
]
