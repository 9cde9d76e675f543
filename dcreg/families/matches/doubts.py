"""What of a registration over matches deserves a second look, each doubt with its remedy."""

from __future__ import annotations

import numpy as np

from dcreg.families.matches.problem import LEAST, MatchProblem

RIVAL = 0.8  # score of a distinct pose, in shares of the best one's, from which on it is told
_REMEDY = "Look at both clouds, or give better matches"
_FLAT = 1e-9  # extent across a line, in extents along it, that is rounding


def doubts(
    problem: MatchProblem,
    chosen: np.ndarray,
    judge: str,
    evidence: list[float],
    unproven: tuple[float, float] | None,
) -> list[str]:
    """One line for each doubt.

    Parameters
    ----------
    problem : MatchProblem
    chosen : int array
        The matches that the pose chooses.
    judge : {"matches", "surfaces"}
    evidence : list of float
        For the pose, then for distinct ones, the best first: scores, or what `coinciding_poses` gives.
    unproven : (float, float), optional
        Where bounds were asked for and did not meet: the score of the pose, and the most that any pose
        can have as far as was proven.
    """
    best, other = [*evidence, 0.0][:2]
    by_chance = _few(chosen) if judge == "surfaces" else _chance(best, other)
    lines = [_undetermined(problem, chosen), _rival(judge, best, other) or by_chance]
    if unproven is not None:
        lines.append(
            f"the search ended early: a pose with a score of up to {unproven[1]:.4g} is not ruled out, "
            f"this one has {unproven[0]:.4g}. Give more time, or fewer matches, the likely ones"
        )
    return [line for line in lines if line is not None]


def _undetermined(problem: MatchProblem, chosen: np.ndarray) -> str | None:
    """More than one pose fits the chosen matches equally well."""
    if len(chosen) >= LEAST:
        matched = problem.list.source[chosen]
        spread = np.linalg.svd(matched - matched.mean(axis=0), compute_uv=False)
        if spread[1] > _FLAT * spread[0]:
            return None
    return (
        f"the source points of the {len(chosen)} chosen matches do not determine the pose: three are "
        "needed that are on no line. Check inlier_distance, in the unit of the clouds, and the matches"
    )


def _rival(judge: str, best: float, other: float) -> str | None:
    """Another pose is nearly as good."""
    if other < RIVAL * best:
        return None
    share = f", {other / best:.0%} of this one" if best > 0.0 else ""
    agrees = "agrees with the matches" + (" and the surfaces" if judge == "surfaces" else "")
    return (
        f"another pose {agrees} nearly as well{share}: either may be right. {_REMEDY}, or several for "
        "each point"
    )


def _chance(best: float, other: float) -> str | None:
    """The next pose is as good as chance makes this one."""
    if best - other >= LEAST:
        return None
    return (
        f"the pose agrees with the matches hardly better than others do (score {best:.3g}, next best "
        f"{other:.3g}); any three matches can agree by chance. {_REMEDY}"
    )


def _few(chosen: np.ndarray) -> str | None:
    """So few matches agree with the pose as often do by chance."""
    if len(chosen) >= 2 * LEAST:
        return None
    return f"only {len(chosen)} matches agree with the pose, and that many often do by chance. {_REMEDY}"
