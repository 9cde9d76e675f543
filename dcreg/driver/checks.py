"""Reject settings that a mode would ignore, and clouds that it cannot search."""

from __future__ import annotations

from dcreg.driver.modes import MAX_PAIRS, NORM_PAIRS, is_matrix_free
from dcreg.families.mode import Mode, all_modes
from dcreg.families.registry import bound_parts
from dcreg.names import DEFAULT_BOUND, MODEL_DIM, mode_names
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
    searches_poses = has_init or has_max_rms or problem.pose_range or problem.weights
    check_bound(mode, bound, may_change_mode=not searches_poses)
    if certificate and not mode.certifies:
        raise InputError(
            f"certificate: mode {mode.name!r} of {problem.model} makes none; {_certifying(problem)}"
        )
    if mode.in_norm_space and (has_init or has_max_rms):
        # the question may be that of `certify` or `max_inliers`, which have neither init nor max_rms
        name = "source, target" if _has_many_pairs(problem) else "mode"
        what = "pose" if has_init else "residual"
        # a sample says nothing about max_rms on all points
        few = FEWER_POINTS if has_max_rms else SAMPLE
        only = norms_only(mode, problem, few, bound=bound)
        raise InputError(f"{name}: a given {what} needs a search over poses, but {only}")
    if problem.pose_range is not None:
        if mode.in_region is None:
            raise InputError(
                f"pose_range: mode {mode.name!r} searches all rotations; {_use_full(bound)}"
            )
        if certificate:
            raise InputError(
                "certificate: `dcreg verify` does not support ranges of poses; omit certificate or "
                "pose_range"
            )
    if problem.weights is not None:
        _check_weights(mode, problem, bound, {"certificate": certificate, "max_rms": has_max_rms})
    n, m = len(problem.source), len(problem.target)
    if n * m > MAX_PAIRS and not is_matrix_free(mode, problem, bound):
        remedy = "downsample both clouds first (downsample=200, or --downsample 200)"
        if problem.model == "rigid3d":
            remedy += f", or use mode 'paper' with bound {DEFAULT_BOUND!r} and without candidates"
        raise InputError(f"source, target: {n} x {m} pairs exceed {MAX_PAIRS:,}; {remedy}")


def _check_weights(
    mode: Mode, problem: Problem, bound: str | None, others: dict[str, bool]
) -> None:
    """Refuse weights or attributes with a mode, a range or other settings that would ignore them."""
    assert problem.weights is not None
    own = problem.weights.name
    others = {"pose_range": problem.pose_range is not None, **others}
    for name in filter(others.get, others):
        raise InputError(f"{name}: cannot be combined with {own}; omit {name} or {own}")
    if not mode.takes_weights:
        raise InputError(
            f"{own}: not supported by {problem.model} in mode {mode.name!r}; {_use_full(bound)}"
        )


def check_bound(mode: Mode, bound: str | None, *, may_change_mode: bool = True) -> None:
    """Refuse an unknown bound, and any bound if the mode has its own."""
    if bound is None:
        return
    bound_parts(bound)  # refuses unknown names
    if mode.make_bound is not None:
        has_other = may_change_mode and "paper" in mode_names(mode.model)
        raise InputError(
            f"bound: mode {mode.name!r} has its own bounds and does not accept {bound!r}; leave "
            f"the bound out{', or choose mode ' + repr('paper') if has_other else ''}"
        )


def _certifying(problem: Problem) -> str:
    """Return what to choose for a certificate: another mode, or a model for points of this dimension."""
    able = [mode for mode in all_modes() if mode.certifies and MODEL_DIM[mode.model] == problem.dim]
    for mode in able:
        if mode.model == problem.model:
            return f"use mode {mode.name!r}"
    models = " or ".join(dict.fromkeys(mode.model for mode in able))
    return f"use {models}, or omit certificate" if models else "omit certificate"


def _use_full(bound: str | None) -> str:
    return f"use mode 'full'{' and omit bound' if bound else ''}"


def _has_many_pairs(problem: Problem) -> bool:
    """Tell whether there are too many pairs of points for a search over poses."""
    return len(problem.source) * len(problem.target) > NORM_PAIRS


def norms_only(mode: Mode, problem: Problem, few: str = SAMPLE, *, bound: str | None = None) -> str:
    """Return why no poses are searched, and what to do, for a message; `few` if the points are many."""
    if _has_many_pairs(problem):
        return (
            f"{len(problem.source):,} x {len(problem.target):,} points are too many for a search over "
            f"poses (at most {NORM_PAIRS:,} pairs of points); {few}"
        )
    return f"mode {mode.name!r} searches norms, not poses; {_use_full(bound)}"
