"""The certificate of one search: its leaves, put down in the terms of the file format.

The only module that knows both the search and the format.
"""

from __future__ import annotations

import numpy as np

from dcreg.certificate import format
from dcreg.certificate.format import Certificate, digest
from dcreg.problem import Frame, Problem
from dcreg.search import Box, Leaves, Outcome
from dcreg.search import boxes as leaves


def record(
    found: Outcome,
    cover: Leaves,
    start: Box,
    problem: Problem,
    *,
    family: str,
    mode: str,
    bound: str,
    gap_tol: float,
) -> Certificate:
    """What the search `found` over `start` proves; all lengths are in the unit of the frame.

    Parameters
    ----------
    found : Outcome
    cover : Leaves
        Of this search.
    start : Box
        Its only root.
    problem : Problem
        As it was given, in its own units.
    family : str
        One of `dcreg.certificate.format.MODELS`.
    mode, bound : str
    gap_tol : float
        In normalised units.
    """
    arrays, frame = cover.arrays(), Frame.of(problem)
    needed = max(found.lower_bound, found.upper_bound - gap_tol)
    pairs = problem.candidates
    return Certificate(
        source_digest=digest(problem.source),
        target_digest=digest(problem.target),
        model=family,
        mode=mode,
        bound=bound,
        status=found.status.value,
        n_inliers=problem.n_inliers,
        scale_range=np.array(problem.scale_range),
        source_centre=frame.source_centre,
        target_centre=frame.target_centre,
        unit=frame.unit,
        start_lower=start.lower,
        start_upper=start.upper,
        leaf_lower=arrays["lower"],
        leaf_upper=arrays["upper"],
        # no more than the statement needs: what a search finds beyond that is costly to prove anew
        leaf_bounds=np.where(
            np.isinf(arrays["bounds"]), arrays["bounds"], np.minimum(arrays["bounds"], needed)
        ),
        leaf_reasons=_format_codes(arrays["reason"]),
        theta=found.theta,
        lower_bound=found.lower_bound,
        upper_bound=found.upper_bound,
        gap_tol=gap_tol,
        candidates=np.empty((0, 2)) if pairs is None else np.argwhere(pairs),
    )


def _format_codes(reasons: np.ndarray) -> np.ndarray:
    """The search's reasons as codes of the file format, each numbered on its own."""
    code_of = {
        leaves.PRUNED: format.PRUNED,
        leaves.EMPTY: format.INADMISSIBLE,
        leaves.OPEN: format.OPEN,
    }
    return np.array([code_of[reason] for reason in reasons.tolist()], dtype=np.int8)
