"""Settings of a method in a config that would have no effect: limits, and numbers of points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from baselines import registry


def stops_at_assignments(baseline: str, options: Mapping[str, Any]) -> bool:
    """Whether a method stops at the limit `assignments`; DC-Reg over matches solves none per box."""
    over_matches = options.get("front_end") is not None
    return registry.read_card(baseline).solves_assignments and not over_matches


def idle_limits(
    own: Mapping[str, Any], all_of_it: Mapping[str, Any], *, stops: bool
) -> Iterable[str]:
    """Yield limits of a method that would be ignored or replaced, and why.

    Parameters
    ----------
    own, all_of_it : mapping
        The limits that the method sets, and all that would apply to it.
    stops : bool
        Whether it stops at a number of assignments.
    """
    given = {key for key, value in own.items() if value is not None}
    safety_s = all_of_it["safety_s"]
    if not stops:
        for key in sorted(given & {"assignments", "safety_s"}):
            yield f"{key}: has no effect, as the method stops at no number of assignments; remove it"
    elif all_of_it["assignments"] is None:
        if "safety_s" in given:
            yield "safety_s: has no effect without a limit on assignments; give time_s instead"
    elif "time_s" in given and safety_s not in (None, own["time_s"]):
        yield f"time_s: safety_s = {safety_s:g} replaces it; give safety_s instead"


def idle_points(
    name: str, baseline: str, options: Mapping[str, Any], n_points: int | None
) -> Iterable[str]:
    """Yield that a method cannot receive fewer points, because it receives pairs of all of them."""
    front_end = str(registry.effective_options(baseline, dict(options)).get("front_end"))
    if n_points is not None and front_end.startswith(("oracle", "shared-")):
        yield (
            f"method {name}: n_points: front_end {front_end} has pairs of all points; remove one of "
            "the two"
        )
