"""Work counters of the benchmark's problems: what `make bench` times, counted.

Times cannot be asserted, counters can: a solver that got slower by searching more shows here. Where the
counters survive rounding, which coordinates moved by 1e-13 stand for, they are stored and asserted
exactly. The tight bound's linearisation point is the end of an iteration, so that rounding shifts its
counters by some per cent: there the range met is stored, and asserted with a margin.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.cases import CASES, Case, Subject
from workflows.stages.worker import COUNTERS

STORED = Path(__file__).with_name("bench_counters.json")
MARGIN = 0.1  # beyond the range met, where rounding matters at all
N_JITTERS = 3
COUNTED = {
    f"{case.name}: {subject}": (dataclasses.replace(case, rounds=1), subject)
    for case in CASES.values()
    if case.counted
    for subject in case.subjects
}


def counters(case: Case, subject: Subject, jitter_seed: int | None = None) -> dict[str, Any]:
    """Status and work of one solve."""
    result = case.solve(subject, 0.0 if jitter_seed is None else 1e-13, jitter_seed or 0)
    return {"status": result.status.value} | {name: getattr(result, name) for name in COUNTERS}


def outcome(case: Case, subject: Subject) -> dict[str, Any]:
    """What is stored: status, range of every counter, and a hash of the points."""
    met = [counters(case, subject, seed) for seed in (None, *range(N_JITTERS))]
    ranges = {name: [min(m[name] for m in met), max(m[name] for m in met)] for name in COUNTERS}
    return {"points": digest(subject), "status": met[0]["status"]} | ranges


def digest(subject: Subject) -> str:
    """Tells a changed problem from a changed solver."""
    problem = subject.problem()
    rounded = [np.rint(problem[name] * 1e6).astype(np.int64) for name in ("source", "target")]
    return hashlib.sha256(b"".join(points.tobytes() for points in rounded)).hexdigest()[:16]


def agrees(found: int, stored: list[int]) -> bool:
    """Exactly, or within the range that rounding makes and its margin."""
    low, high = stored
    return found == low if low == high else (1 - MARGIN) * low <= found <= (1 + MARGIN) * high
