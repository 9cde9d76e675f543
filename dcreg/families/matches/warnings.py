"""Warnings about a registration over matches, each with what to do."""

from __future__ import annotations

import numpy as np

from dcreg.families.matches.problem import MIN_MATCHES, MatchProblem

RUNNER_UP_RATIO = (
    0.8  # minimum score, relative to that of the best pose, of another pose that is reported
)
_REMEDY = "Look at the clouds at this pose, or give better matches"
# Why a search ended without a proof.
LIMIT, TOLERANCE, NO_PROSPECT = "limit", "tolerance", "no prospect"
_ENDS = {
    LIMIT: ("early", "Allow more time, or give only the most likely matches"),
    TOLERANCE: ("because the cost is within the tolerance", "Omit abs_gap"),
    NO_PROSPECT: (
        "because no proof is expected soon",
        "Set certify=True (--certify) to search to the time limit, or give only the most likely matches",
    ),
}
_FLAT = 1e-9  # extent across a line, relative to the extent along it, that counts as rounding


def warnings_of(
    problem: MatchProblem,
    chosen: np.ndarray,
    score: str,
    evidence: list[float],
    unproven: tuple[float, float] | None,
    end: str = LIMIT,
) -> list[str]:
    """Return the warnings, one line each.

    Parameters
    ----------
    problem : MatchProblem
    chosen : int array
        The matches that the pose selects.
    score : {"correspondences", "surfaces"}
    evidence : list of float
        Scores of the pose and of distinct poses, best first; for surfaces, those of
        `surface_consistent_poses`.
    unproven : (float, float), optional
        If bounds were requested and prove no optimum: the score of the pose, and the proven upper bound
        on that of any pose.
    end : {LIMIT, TOLERANCE, NO_PROSPECT}
        Why the search ended.
    """
    best, other = [*evidence, 0.0][:2]
    by_chance = _few(chosen) if score == "surfaces" else _chance(best, other)
    lines = [_undetermined(problem, chosen), _runner_up(score, best, other) or by_chance]
    if unproven is not None:
        why, remedy = _ENDS[end]
        lines.append(
            f"the search ended {why}: a pose with a score of up to {unproven[1]:.4g} is not ruled out, "
            f"this one has {unproven[0]:.4g}. {remedy}"
        )
    return [line for line in lines if line is not None]


def is_clear(score: str, best: float, other: float) -> bool:
    """Tell whether the best pose is clearly better than another one."""
    return not (_runner_up(score, best, other) or _chance(best, other))


def _undetermined(problem: MatchProblem, chosen: np.ndarray) -> str | None:
    """Warn if several poses fit the selected matches equally well."""
    if len(chosen) >= MIN_MATCHES:
        matched = problem.list.source[chosen]
        spread = np.linalg.svd(matched - matched.mean(axis=0), compute_uv=False)
        if spread[1] > _FLAT * spread[0]:
            return None
    return (
        f"the source points of the {len(chosen)} selected matches do not determine the pose; at least "
        "three that are not collinear are needed. Check the matches and inlier_distance (in units of "
        "the clouds)"
    )


def _runner_up(score: str, best: float, other: float) -> str | None:
    """Warn if another pose is nearly as good."""
    if other < RUNNER_UP_RATIO * best:
        return None
    share = f" ({other / best:.0%} of the score)" if best > 0.0 else ""
    agrees = "agrees with the matches" + (" and the surfaces" if score == "surfaces" else "")
    return (
        f"another pose {agrees} nearly as well{share}: either may be right. {_REMEDY} (several per "
        "point)"
    )


def _chance(best: float, other: float) -> str | None:
    """Warn if the lead over the next pose is so small that chance can explain it."""
    if best - other >= MIN_MATCHES:
        return None
    return (
        f"the pose agrees with the matches hardly better than others do (score {best:.3g}, next best "
        f"{other:.3g}); any three matches can agree by chance. {_REMEDY}"
    )


def _few(chosen: np.ndarray) -> str | None:
    """Warn if so few matches agree with the pose that they may agree by chance."""
    if len(chosen) >= 2 * MIN_MATCHES:
        return None
    return f"only {len(chosen)} matches agree with the pose, and as many often agree by chance. {_REMEDY}"
