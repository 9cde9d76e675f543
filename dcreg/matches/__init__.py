"""Rigid registration over a list of given matches: sparse feasible pairs of large clouds."""

from dcreg.matches.bound import MatchBound
from dcreg.matches.problem import MatchProblem
from dcreg.matches.start import promising_poses

__all__ = ["MatchBound", "MatchProblem", "promising_poses"]
