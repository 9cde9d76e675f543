"""Local steps at a pose: matching, least-squares fit, polish."""

from dcreg.local.assignment import k_assignment, pairs_of
from dcreg.local.fit import fit_pose
from dcreg.local.polish import objective, polish

__all__ = ["fit_pose", "k_assignment", "objective", "pairs_of", "polish"]
