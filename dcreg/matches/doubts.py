"""What of a registration over matches deserves a second look, each doubt with its remedy."""

from __future__ import annotations

import numpy as np

from dcreg.matches.problem import LEAST, MatchProblem

RIVAL = 0.8  # score of a distinct pose, in shares of the best one's, from which on it is told
_FLAT = 1e-9  # extent across a line, in extents along it, that is rounding


def doubts(
    problem: MatchProblem,
    chosen: np.ndarray,
    score: tuple[float, float],
    others: list[float],
    is_open: bool,
) -> list[str]:
    """One line for each doubt.

    Parameters
    ----------
    problem : MatchProblem
    chosen : int array
        The matches that the pose chooses.
    score : (float, float)
        Of the pose, and the most that any pose can have as far as was proven.
    others : list of float
        Scores of distinct poses, the best first.
    is_open : bool
        Whether bounds were asked for and did not meet.
    """
    lines = [_undetermined(problem, chosen), _rival(score[0], others)]
    if is_open:
        lines.append(
            f"the search ended early: a pose with a score of up to {score[1]:.4g} is not ruled out, this "
            f"one has {score[0]:.4g}. Give more time, or fewer matches, the likely ones"
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


def _rival(best: float, others: list[float]) -> str | None:
    """Another pose is nearly as good, or no worse than chance alone makes it."""
    other = others[0] if others else 0.0
    if other >= RIVAL * best:
        return (
            f"another pose agrees with the matches nearly as well, {other / best:.0%} of this one: "
            "either may be right. Look at both clouds, or give better matches, or several for each point"
        )
    if best - other >= LEAST:
        return None
    return (
        f"the pose agrees with the matches hardly better than others do (score {best:.3g}, next best "
        f"{other:.3g}); any three matches can agree by chance. Look at both clouds, or give better "
        "matches"
    )
