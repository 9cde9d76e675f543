"""Declared versions of methods, and the code that is known to give the results of a version.

``baselines/versions.json`` has, for each method, the version that its card declares, the hashes of code
with the results of this version, and these results for a few small problems. Runs of the same version
are comparable and need not be repeated, also if code was moved in between.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines import registry
from dcreg.files import whole_file
from dcreg.status import Status
from workflows.config import LimitSettings, MethodSettings
from workflows.outcomes import GROUPS
from workflows.stages.generate import instance_of
from workflows.stages.plan import InstanceSpec
from workflows.stages.sandbox import Sandbox
from workflows.stages.worker import COUNTERS

KNOWN, SAME, REVIEWED, NEW, CHANGED, UNKNOWN, LOWERED = (
    "known", "same results", "accepted without a check", "not stored yet", "results changed",
    "cannot be checked", "version lowered",
)  # fmt: skip
REMEDIES = {
    CHANGED: "raise `version` in its card.yaml, and run this command again with --accept",
    UNKNOWN: "raise `version` in its card.yaml, or accept it by --accept --reviewed {name}",
    LOWERED: "restore `version` in its card.yaml",
}
PROBLEMS = [
    InstanceSpec("embedded", shape, test, 0.2, trial=0, n_points=12, model=model)
    for model, shape in (("similarity2d", "fish"), ("rigid3d", "pony"))
    for test in ("separate_outliers", "occlusion_outliers")
] + [InstanceSpec("embedded", "pony", "mixed_outliers", 0.3, trial=0, n_points=60, model="rigid3d")]
# Of methods that solve assignments, their number ends a search before the time does.
LIMITS = LimitSettings(time_s=20.0, memory_mb=8192, assignments=500)
MOST_CODES = 20  # hashes kept for each version
_DIGITS = 6  # of a pose: the last bits differ between machines


@dataclass(frozen=True)
class Check:
    """State of the declared version of one method."""

    name: str
    state: str

    @property
    def is_settled(self) -> bool:
        """Whether the code of the method is known, or may be stored as known."""
        return self.state not in REMEDIES

    @property
    def remedy(self) -> str:
        return REMEDIES.get(self.state, "").format(name=self.name)


def results_of(name: str) -> list[dict[str, Any]] | None:
    """Return the results of a method for `PROBLEMS`; None if they cannot be compared.

    This is so if the method is not available here, or not deterministic.
    """
    if not registry.read_card(name).deterministic:
        return None
    found = []
    outliers = registry.oracle_outliers(name, {})
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        with Sandbox(MethodSettings(name=name, baseline=name), LIMITS, log) as sandbox:
            for spec in PROBLEMS:
                answer = sandbox.solve(instance_of(spec, 1.0, 0, outliers))
                if answer["status"] == Status.UNAVAILABLE:
                    return None
                found.append(comparable(answer))
    return found


def are_equal(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Tell whether two results are equal, or the clock ended one of them."""
    return one == other or any(GROUPS[Status(each["status"])].is_timed for each in (one, other))


def _repeats(found: dict[str, Any], stored: dict[str, Any]) -> bool:
    """Tell whether a result repeats a stored one, unless the clock ended that one."""
    return found == stored or GROUPS[Status(stored["status"])].is_timed


def comparable(answer: dict[str, Any]) -> dict[str, Any]:
    """Return what repeats exactly, rounded: status, counters, bounds and pose."""
    pose = answer.get("T_target_source")
    rounded = None if pose is None else (np.round(pose, _DIGITS) + 0.0).tolist()
    counters = {name: answer[name] for name in COUNTERS if answer.get(name) is not None}
    bounds = {name: _rounded(answer.get(name)) for name in ("lower_bound", "upper_bound")}
    return {"status": Status(answer["status"]).value, **counters, **bounds, "pose": rounded}


def _rounded(value: float | None) -> str | None:
    return None if value is None else f"{value:.{_DIGITS}g}"


def check(names: Iterable[str], reviewed: Iterable[str] = (), *, accept: bool) -> Iterator[Check]:
    """Compare the code of methods with what is stored, and with `accept` store what is settled.

    Parameters
    ----------
    names : iterable of str
    reviewed : iterable of str
        Methods that are accepted without a comparison if none is possible here.
    accept : bool
    """
    reviewed = {name for name in reviewed if name}
    for name in reviewed:
        registry.root_of(name)  # an unknown name is an error
    for name in names:
        root = registry.root_of(name)
        stored = registry.known_codes(root)
        found, entry = _checked(name, stored.get(name), name in reviewed)
        if accept and found.is_settled and entry != stored.get(name):
            _write({**stored, name: entry}, root)
        yield found


def _checked(
    name: str, known: dict[str, Any] | None, reviewed: bool
) -> tuple[Check, dict[str, Any] | None]:
    """Return the state of a method, and its entry in the file if the state is accepted."""
    code, version = registry.code_hash(name), registry.read_card(name).version
    if known is None or version > known["version"]:
        entry = {"version": version, "codes": [code], "results": results_of(name)}
        return Check(name, NEW), entry
    if version < known["version"]:
        return Check(name, LOWERED), known
    if code in known["codes"]:
        return Check(name, KNOWN), known
    extended = {**known, "codes": [*known["codes"], code][-MOST_CODES:]}
    results = results_of(name)
    if results is None or known["results"] is None:
        return (Check(name, REVIEWED), extended) if reviewed else (Check(name, UNKNOWN), known)
    if all(map(_repeats, results, known["results"])):
        return Check(name, SAME), extended
    return Check(name, CHANGED), known


def _write(entries: dict[str, Any], root: Path) -> None:
    lines = (f"{json.dumps(name)}: {json.dumps(entries[name])}" for name in sorted(entries))
    with whole_file(root / registry.VERSIONS) as part:
        part.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
