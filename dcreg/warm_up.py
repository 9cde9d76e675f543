"""Compile kernels before they are needed."""

from __future__ import annotations

import functools

import numpy as np

from dcreg.local import polish
from dcreg.local.sampled_rotation import search_sampled_rotation
from dcreg.local.sparse import sparse_matching
from dcreg.modes import MODES, Mode, Task
from dcreg.search import Budget


def warm_up() -> None:
    """Compile every kernel into the on-disk cache, so that no later process waits for it."""
    for mode in MODES:
        for bound in ("tight", "paper", "edges") if mode.takes_bound else (None,):
            warm_up_mode(mode, bound)
        if mode.model == "similarity2d":
            warm_up_mode(mode, "termwise")
    points = np.random.default_rng(0).standard_normal((20, 3))
    search_sampled_rotation(points, points, 20, gap_tol=0.0, budget=Budget())
    sparse_matching(points, points, 15)


@functools.cache
def warm_up_mode(mode: Mode, bound: str | None) -> None:
    """Compile (or load from cache) every kernel of a mode on a tiny problem, once a process."""
    generator = np.random.default_rng(0)
    dim = 2 if mode.model == "similarity2d" else 3
    scale_range = (0.5, 1.5) if dim == 2 else (1.0, 1.0)
    points = generator.standard_normal((8, dim))
    moved = points[:, ::-1].copy()
    for n_inliers in (6, 8):  # both assignment solvers
        mode.run(
            Task(
                points, moved, n_inliers, scale_range, None, bound or mode.own_bound, False, 0.5, 1,
                Budget(nodes=8),
            )
        )  # fmt: skip
        polish(points, moved, np.eye(dim + 1), n_inliers, scale_range)
