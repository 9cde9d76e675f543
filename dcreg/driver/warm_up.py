"""Compile kernels before they are needed. ``python -m dcreg.driver.warm_up`` compiles all of them."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Iterator

import numpy as np

from dcreg.assignment.descent import polish
from dcreg.assignment.objective import objective
from dcreg.assignment.sparse import sparse_matching
from dcreg.driver.modes import Attempt, compile_cover, run_mode
from dcreg.driver.normalised import NormalisedProblem
from dcreg.families.mode import Mode, all_modes
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.kernels.boxes import FEW_PAIRS
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.sampled import search_sampled_rotation
from dcreg.jit import forget_old_kernels, when_compiling
from dcreg.names import BOUND_NAMES, COMPILING, MODEL_DIM
from dcreg.problem import Frame, PoseRange, Problem
from dcreg.problem.problem import DEFAULT_SCALE_RANGE
from dcreg.search import Box, Boxes, Budget, Tolerance

_LOGGER = logging.getLogger("dcreg")


def warm_up(processes: int = 1) -> None:
    """Compile every kernel into the on-disk cache, so that no later process waits for it.

    Kernels of earlier versions of the library are removed from the cache.

    Parameters
    ----------
    processes : int
        Processes that share the work. More processes take less time but more CPU time, because some
        kernels are then compiled more than once.
    """
    forget_old_kernels()
    works = list(_works())
    if processes == 1:
        for work in works:
            work()
        return
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context) as pool:
        for done in [pool.submit(work) for work in works]:
            done.result()


def _works() -> Iterator[functools.partial[None]]:
    """All there is to compile, in parts that have little in common."""
    yield functools.partial(warm_up_matches)
    yield functools.partial(compile_covers)
    for mode in sorted(all_modes(), key=lambda mode: mode.name):  # the most expensive first
        yield functools.partial(_compile_mode, mode)


def compile_covers() -> None:
    """Compile what a long search needs; other searches do not wait for it."""
    for mode in all_modes():
        compile_cover(mode)


def _compile_mode(mode: Mode) -> None:
    bounds: list[str | None] = [None]
    if mode.make_bound is None:
        bounds += [name for name in BOUND_NAMES if name != mode.own_bound]
    for bound in bounds:
        for restricted in (False, True):
            warm_up_mode(mode, bound, restricted)
    warm_up_mode(mode, None, many=True, large=True)
    if mode.model == "similarity3d":
        for restricted in (False, True):
            warm_up_mode(mode, None, restricted, many=True, whole=True)
    warm_up_region(mode)


@functools.cache
def warm_up_mode(
    mode: Mode,
    bound: str | None,
    restricted: bool = False,
    many: bool = False,
    large: bool = False,
    whole: bool = False,
) -> None:
    """Compile (or load from cache) the kernels that a mode and a bound need, once a process.

    They are those that a search of a tiny problem meets. Where one of them has to be compiled, a record
    of level INFO goes to the logger ``dcreg`` first.

    Parameters
    ----------
    mode : Mode
    bound : str or None
        None: the mode's own.
    restricted : bool
        Whether not every pair is feasible.
    many : bool
        Whether there are more than `FEW_PAIRS` pairs of points.
    large : bool
        Whether the clouds are too large for a dense matrix.
    whole : bool
        Whether all points of both clouds match, where this needs other kernels.
    """
    generator = np.random.default_rng(0)
    dim, scale_range = MODEL_DIM[mode.model], DEFAULT_SCALE_RANGE[mode.model]
    points = generator.standard_normal((8, dim))
    points -= points.mean(axis=0)
    moved = points[:, ::-1].copy()
    candidates = ~np.eye(8, dtype=bool) if restricted else None
    with when_compiling(lambda: _LOGGER.info(COMPILING)):
        run_mode(
            mode,
            NormalisedProblem(
                points, moved, 8 if whole else 6, scale_range, candidates,
                Frame(np.zeros(dim), np.zeros(dim), 1.0), bound or mode.own_bound,
                stationary_box=whole, tolerance=Tolerance(),
                threads=1, budget=Budget(nodes=8),
            ),
        )  # fmt: skip
        polish(Problem(points, moved, 6, mode.model, candidates=candidates), np.eye(dim + 1))
        # what is met past the limit
        objective(points, moved, np.eye(dim + 1), 6, stop=np.ones(1, np.uint8))
        if many and mode.name == "full" and (mode.model == "rigid3d" or whole):
            cloud = generator.standard_normal((1 + FEW_PAIRS, 3))
            space = Rigid3D(cloud[:1], cloud, 1)
            (box, *_) = space.roots()
            RigidBound(space).evaluate(Boxes.of([box]), None)
        if large:
            sparse_matching(points, moved, 6)
            if mode.model == "rigid3d":
                search_sampled_rotation(points, moved, 6, tolerance=Tolerance(), budget=Budget())


@functools.cache
def warm_up_region(mode: Mode) -> None:
    """Compile (or load from cache) what a search of a range of poses needs besides, once a process."""
    if mode.in_region is None:
        return
    from dcreg.families.region import Near

    points = np.random.default_rng(0).standard_normal((8, MODEL_DIM[mode.model]))
    problem = Problem(points, points[:, ::-1], 6, mode.model, pose_range=PoseRange(max_angle=30.0))
    frame = Frame.of(problem)
    assert problem.pose_range is not None
    with when_compiling(lambda: _LOGGER.info(COMPILING)):
        normalised = NormalisedProblem(
            frame.source(problem.source), frame.target(problem.target), 6, problem.scale_range, None,
            frame, mode.own_bound, stationary_box=True, tolerance=Tolerance(), threads=1,
            budget=Budget(nodes=8), region=Near(frame.pose_range(problem.pose_range)),
        )  # fmt: skip
        attempt = Attempt(mode, normalised)
        attempt.run(normalised.budget)
        root = attempt.bound.roots[0]
        small = Box(root.centre - 1e-3 * root.half_widths, root.centre + 1e-3 * root.half_widths)
        attempt.bound.evaluate(Boxes.of([small]), None)


@functools.cache
def warm_up_matches() -> None:
    """Compile (or load from cache) the kernels of `dcreg.register_matches`, once a process."""
    from dcreg.families.matches.bound import MatchBound
    from dcreg.families.matches.problem import MatchProblem
    from dcreg.families.matches.start import promising_poses, surface_consistent_poses

    points = np.random.default_rng(0).standard_normal((8, 3))
    rows = np.arange(8)
    problem = MatchProblem(points, points, np.column_stack([rows, rows]), 0.5)
    with when_compiling(lambda: _LOGGER.info(COMPILING)):
        promising_poses(problem, Budget())
        surface_consistent_poses(problem, Budget())
        worst = problem.inlier_threshold**2 * problem.max_cardinality
        bound = MatchBound(problem, worst, Tolerance())
        bound.search(Budget(nodes=8), (np.eye(3, 4).ravel(), worst))


if __name__ == "__main__":
    warm_up(processes=min(len(all_modes()), os.cpu_count() or 1))
