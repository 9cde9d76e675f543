"""Reject settings that a mode would ignore, and clouds that it cannot search."""

from __future__ import annotations

from dcreg.assignment.objective import AT_ONCE_PAIRS
from dcreg.driver.modes import MAX_PAIRS, NORM_PAIRS, is_matrix_free
from dcreg.families.mode import Mode
from dcreg.families.registry import bound_parts
from dcreg.names import DEFAULT_BOUND, mode_names
from dcreg.problem import InputError, Problem

FEWER_POINTS = "give fewer points, such as keypoints"
SAMPLE = "search a smaller sample (downsample=400, or --downsample 400)"


def check_mode(
    mode: Mode,
    problem: Problem,
    bound: str | None,
    certificate: bool,
    *,
    has_init: bool = False,
    has_max_rms: bool = False,
) -> None:
    """Reject settings that this mode would ignore, and clouds that do not fit into memory.

    Raises
    ------
    InputError
    """
    check_bound(mode, bound)
    if certificate and not mode.certifies:
        remedy = f"no mode of {problem.model} does, so omit certificate"
        remedy = "use mode 'paper'" if _has_paper(problem.model) else remedy
        raise InputError(f"certificate: mode {mode.name!r} makes none; {remedy}")
    for name, given in (("init", has_init), ("max_rms", has_max_rms)):
        if given and mode.in_norm_space:
            # a sample says nothing about max_rms on all points
            few = FEWER_POINTS if has_max_rms else SAMPLE
            raise InputError(f"{name}: {norms_only(mode, problem, few)}")
    if problem.pose_range is not None:
        if mode.in_region is None:
            raise InputError(
                f"pose_range: mode {mode.name!r} searches all rotations; use mode 'full', or omit mode, "
                "bound and certificate"
            )
        if certificate:
            raise InputError(
                "certificate: `dcreg verify` does not support ranges of poses; omit certificate or "
                "pose_range"
            )
    if problem.weights is not None:
        _check_weights(mode, problem, {"certificate": certificate, "max_rms": has_max_rms})
    n, m = len(problem.source), len(problem.target)
    if n * m > MAX_PAIRS and not is_matrix_free(mode, problem, bound):
        remedy = "downsample both clouds first (downsample=200, or --downsample 200)"
        if problem.model == "rigid3d":
            remedy += f", or use mode 'paper' with bound {DEFAULT_BOUND!r} and without candidates"
        raise InputError(f"source, target: {n} x {m} pairs exceed {MAX_PAIRS:,}; {remedy}")


def _check_weights(mode: Mode, problem: Problem, others: dict[str, bool]) -> None:
    """Refuse weights with a mode, a range, clouds or other settings that would ignore them."""
    others = {"pose_range": problem.pose_range is not None, **others}
    for name in filter(others.get, others):
        raise InputError(f"{name}: cannot be combined with weights; omit {name} or weights")
    n, m = problem.weights.factors.shape if problem.weights else (0, 0)
    if n * m > AT_ONCE_PAIRS:
        raise InputError(
            f"weights: {n} x {m} pairs exceed {AT_ONCE_PAIRS:,}; downsample both clouds first, or omit "
            "weights"
        )
    if not mode.takes_weights:
        raise InputError(
            f"weights: not supported by {problem.model} in mode {mode.name!r}; use similarity2d, or "
            "rigid3d in mode 'full' without bound"
        )


def check_bound(mode: Mode, bound: str | None) -> None:
    """Refuse an unknown bound, and any bound if the mode has its own."""
    if bound is None:
        return
    bound_parts(bound)  # refuses unknown names
    if mode.make_bound is not None:
        raise InputError(
            f"bound: mode {mode.name!r} has its own bounds and does not accept {bound!r}; leave "
            f"the bound out{', or choose mode ' + repr('paper') if _has_paper(mode.model) else ''}"
        )


def _has_paper(model: str) -> bool:
    return "paper" in mode_names(model)


def norms_only(mode: Mode, problem: Problem, few: str = SAMPLE) -> str:
    """Return why no poses are searched, and what to do, for a message; `few` if the points are many."""
    n, m = len(problem.source), len(problem.target)
    if n * m > NORM_PAIRS:
        return (
            f"{n:,} x {m:,} points are too many for a search over poses (at most {NORM_PAIRS:,} pairs of "
            f"points); {few}"
        )
    searched = f"mode {mode.name!r} searches norms, not poses"
    return f"{searched}; use mode 'full', and omit bound and certificate"
