"""An estimate of the memory that a solve needs, from the sizes of the clouds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from dcreg.assignment.objective import is_large
from dcreg.driver.modes import is_matrix_free
from dcreg.families.mode import Mode
from dcreg.problem import InputError, Problem, unit_length
from dcreg.result_parts import MemoryEstimate

MB = 2**20
PROCESS_MB = 200.0  # Python, its libraries and the kernels
COST_BYTES = 12  # per pair of points: costs in double and in single precision
PENALTY_BYTES = 9  # per pair of points, if there are candidates
WEIGHT_BYTES = (
    48  # per pair of points: factors and constants, also in the units of the search, and copies
)
ATTRIBUTE_BYTES = 8  # per pair of points, in addition: the costs of attributes
SPACE_BYTES, MAX_SPACES = 100, 12  # per point: the copies of a space for another number of pairs
POINT_BYTES = 250  # per point: copies, search trees and neighbours
STORED_2D_MB, STORED_3D_MB = 400.0, 150.0  # what bounds store at most about vertices of boxes
OPTIMISM = 0.7  # measured memory, divided by the estimate, at least
# Pairs of points, or seconds, from which a solve is large work.
MANY_PAIRS, LONG_S = 1_000_000, 600.0


def estimated_memory(
    problem: Problem, searched: Problem, mode: Mode, bound: str | None, n_numbers: int = 1
) -> MemoryEstimate:
    """Return the memory that a problem needs if `searched`, a sample or all points, is searched.

    A sweep, and the choice of the number of pairs, keep a copy of the searched points for each of
    `n_numbers`; at most `MAX_SPACES` of them count.
    """
    n, m = len(searched.source), len(searched.target)
    pairs, is_free = n * m, searched.candidates is None
    search = 0 if is_matrix_free(mode, searched, bound) else COST_BYTES * pairs
    by_vertices = mode.in_norm_space or problem.dim == 2
    if not by_vertices:
        fields = _field_bytes(searched)
        search = max(search, fields) if is_free else search + fields
    n, m = len(problem.source), len(problem.target)
    matching = 0 if is_free and is_large(n, m) else 8 * (problem.dim + 1) * n * m
    needed = max(search, matching) + POINT_BYTES * (n + m)
    needed += 0 if is_free else PENALTY_BYTES * pairs
    if problem.weights is not None:
        has_attributes = problem.weights.attributes is not None
        needed += (WEIGHT_BYTES + ATTRIBUTE_BYTES * has_attributes) * pairs
    n_more = min(n_numbers, MAX_SPACES) - 1
    needed += n_more * SPACE_BYTES * (len(searched.source) + len(searched.target))
    dim, duals = (3, 0) if mode.in_norm_space else (4, 0)
    if not by_vertices:
        dim, duals = 7 + problem.has_scale, max(len(searched.source), len(searched.target))
    return MemoryEstimate(
        peak_mb=PROCESS_MB + needed / MB,
        stored_mb=STORED_2D_MB if by_vertices else STORED_3D_MB,
        box_bytes=16 * dim + 40 + 2 * duals,
    )


def _field_bytes(searched: Problem) -> int:
    """Return the memory of the fields by which initial poses in 3D are scored."""
    from dcreg.families.rigid3d.space import COARSE_PAIRS, COARSE_POINTS, DENSE_DESCENTS
    from dcreg.families.rigid3d.starts import MAX_CELLS, N_THREADS, SCALES
    from dcreg.families.starts import CELLS_PER_REACH

    n, m = len(searched.source), len(searched.target)
    if searched.n_inliers == n == m:  # only rotations are searched
        return 0
    larger = searched.target if m >= n else searched.source
    if n * m > COARSE_PAIRS and searched.candidates is None:  # they are found with few points
        larger = larger[:: max(1, len(larger) // COARSE_POINTS)]
    reach = SCALES[0].reach * unit_length(larger, larger) or np.inf
    cells = min(MAX_CELLS, CELLS_PER_REACH * float(np.ptp(larger, axis=0).max()) / reach)
    count = N_THREADS if n * m > DENSE_DESCENTS else 1
    return count * 8 * math.ceil(cells + 2.0 * CELLS_PER_REACH + 1.0) ** 3


def check_memory(estimate: MemoryEstimate, problem: Problem) -> None:
    """Refuse a problem that does not fit into the memory that is available.

    Raises
    ------
    InputError
    """
    free = available_mb()
    # the process itself is in the memory already
    if OPTIMISM * (estimate.peak_mb - PROCESS_MB) > free:
        n, m = len(problem.source), len(problem.target)
        raise InputError(
            f"source, target: {n:,} and {m:,} points need about {estimate.peak_mb:,.0f} MB of memory, "
            f"but {free:,.0f} MB are available; search a sample (downsample=200, or --downsample 200), "
            "or give fewer points if the command refuses samples"
        )


def available_mb() -> float:
    """Return the memory that this process can still use; inf if the system is not Linux."""
    free = math.inf
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = (
            int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]) / 1024
        )
    with suppress(OSError, ValueError):  # a container with a limit
        folder = Path("/sys/fs/cgroup")
        most, used = (int((folder / f"memory.{name}").read_text()) for name in ("max", "current"))
        lines = (folder / "memory.stat").read_text().splitlines()
        cached = sum(int(line.split()[1]) for line in lines if line.startswith("inactive_file "))
        free = min(free, max(0.0, (most - used + cached) / MB))
    return free


def is_large_work(problem: Problem, time_s: float | None) -> bool:
    """Tell whether memory and time of a solve are announced."""
    is_long = time_s is None or time_s >= LONG_S
    return is_long or len(problem.source) * len(problem.target) > MANY_PAIRS


def advance_notice(
    estimate: MemoryEstimate, time_s: float | None, stages: Mapping[str, float]
) -> str:
    """Return what a large solve may need, as text; `stages` are the seconds of other stages."""
    limit = math.inf if time_s is None else time_s
    time = f"at most about {limit:,.0f} s" if math.isfinite(limit) else "no limit"
    parts = [f"{name} about {max(seconds, 0.1):.2g} s" for name, seconds in stages.items()]
    first = f" ({', '.join(parts)})" if parts else ""
    return f"estimated memory: {estimate}; time: {time}{first}. The time until the proof is not known yet"
