"""Settings of a method in a config that would have no effect: limits, and numbers of points."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from baselines import registry

if TYPE_CHECKING:
    from workflows.config import Experiment, MethodSettings


def stops_at_assignments(method: MethodSettings) -> bool:
    """Whether a method stops at the limit `assignments`; DC-Reg over matches solves none per box."""
    over_matches = method.options.get("front_end") is not None
    return registry.read_card(method.baseline).solves_assignments and not over_matches


def idle_limits(settings: Experiment, method: MethodSettings) -> Iterable[str]:
    """Yield limits of a method that would be ignored or replaced, and why."""
    given = {key for key, value in method.limits.items() if value is not None}
    limits = settings.limits_of(method)
    if not stops_at_assignments(method):
        for key in sorted(given & {"assignments", "safety_s"}):
            yield f"{key}: has no effect, as {method.name} stops at no number of assignments; remove it"
    elif limits.assignments is None and "safety_s" in given:
        yield "safety_s: has no effect without a limit on assignments; give time_s instead"
    elif (
        limits.assignments is not None
        and "time_s" in given
        and limits.safety_s not in (None, limits.time_s)
    ):
        yield f"time_s: safety_s = {limits.safety_s:g} replaces it; give safety_s instead"


def idle_points(settings: Experiment) -> Iterable[str]:
    """Yield methods that receive fewer points, but pairs of all points."""
    for method in settings.methods:
        options = registry.effective_options(method.baseline, method.options)
        front_end = str(options.get("front_end"))
        if method.n_points is not None and front_end.startswith(("oracle", "shared-")):
            yield (
                f"method {method.name}: n_points: front_end {front_end} has pairs of all points; "
                "remove one of the two"
            )
