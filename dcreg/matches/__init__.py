"""Rigid registration over a list of given matches: sparse feasible pairs of large clouds."""

from dcreg.matches.bound import MatchBound
from dcreg.matches.doubts import doubts
from dcreg.matches.problem import MatchProblem
from dcreg.matches.start import coinciding_poses, is_near, promising_poses

__all__ = ["MatchBound", "MatchProblem", "coinciding_poses", "doubts", "is_near", "promising_poses"]
