"""What of a registration over matches deserves a second look, each doubt with its remedy."""

from __future__ import annotations

import numpy as np

from dcreg.matches.problem import LEAST, MatchProblem

RIVAL = 0.8  # score of a distinct pose, in shares of the best one's, from which on it is told
_FLAT = 1e-9  # extent across a line, in extents along it, that is rounding


def doubts(
    problem: MatchProblem,
    value: float,
    chosen: np.ndarray,
    others: list[float],
    nothing_proven: bool,
) -> list[str]:
    """One line for each doubt.

    Parameters
    ----------
    problem : MatchProblem
    value : float
        Cost of the pose.
    chosen : int array
        The matches that it chooses.
    others : list of float
        Costs of distinct poses, the best first.
    nothing_proven : bool
        Whether bounds were asked for and did not leave zero.
    """
    lines = [_undetermined(problem, chosen), _rival(problem, value, others)]
    if nothing_proven:
        lines.append(
            "the lower bound is 0: nothing proves that no other pose agrees with more of the matches. "
            "Give more time, or fewer matches, the likely ones"
        )
    return [line for line in lines if line is not None]


def _undetermined(problem: MatchProblem, chosen: np.ndarray) -> str | None:
    """More than one pose fits the chosen matches equally well."""
    matched = problem.list.source[chosen]
    spread = np.linalg.svd(matched - matched.mean(axis=0), compute_uv=False)
    if len(chosen) >= LEAST and spread[1] > _FLAT * spread[0]:
        return None
    return (
        f"the source points of the {len(chosen)} chosen matches do not determine the pose: three are "
        "needed that are on no line. Check inlier_distance, in the unit of the clouds, and the matches"
    )


def _rival(problem: MatchProblem, value: float, others: list[float]) -> str | None:
    """Another pose is nearly as good."""
    best, *rest = ((problem.most - cost / problem.reach**2) for cost in (value, *others))
    if not rest or rest[0] < RIVAL * best:
        return None
    return (
        f"another pose agrees with the matches nearly as well, {rest[0] / best:.0%} of this one: either "
        "may be right. Look at both clouds, or give better matches, or several for each point"
    )
