"""The certificate of one search: its leaves in the terms of the file format.

This is the only module that knows both the search and the format.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import DUAL_UNIT
from dcreg.certificate.format import INADMISSIBLE, OPEN, PRUNED, Certificate, digest
from dcreg.problem import Frame, Problem
from dcreg.search import Box, Boxes, Outcome
from dcreg.search.boxes import morton_order

LARGEST_DUAL = 15  # in 4 bits


def record(
    found: Outcome, start: Box, problem: Problem, frame: Frame, gap_tol: float, **names: str
) -> Certificate:
    """Return what the search `found` over `start` proves, in normalised units.

    Parameters
    ----------
    found : Outcome
        With its leaves.
    start : Box
        Its root; if there are several, the smallest box that contains all of them.
    problem : Problem
        As given, in its own units.
    frame : Frame
        Of the problem.
    gap_tol : float
        In normalised units.
    **names : str
        ``model`` (one of `dcreg.certificate.format.MODELS`), ``mode`` and ``bound``.
    """
    assert found.leaves is not None
    boxes, is_open = found.leaves.boxes, found.leaves.is_open
    needed = max(found.lower_bound, found.upper_bound - gap_tol)
    lower_bound = found.lower_bound
    if names["model"] == "rigid3d" and found.upper_bound > gap_tol:
        # the tolerance needs no more, and in six dimensions a larger bound takes many more boxes
        lower_bound = min(lower_bound, found.upper_bound - gap_tol)
        needed = found.upper_bound - gap_tol
    if names["model"] == "rigid3d":  # the check is faster if near leaves are near in the file
        order = morton_order(boxes.lower + boxes.upper)
        boxes, is_open = boxes[order], is_open[order]
    pairs, is_empty = problem.candidates, np.isinf(boxes.bounds)
    # with `max_rms`, boxes are no longer divided from a smaller bound on
    is_open = is_open | (boxes.bounds < found.upper_bound - gap_tol)
    duals, units = _stored_duals(boxes, names["model"])
    return Certificate(
        source_digest=digest(problem.source),
        target_digest=digest(problem.target),
        status=found.status.value,
        n_inliers=problem.n_inliers,
        scale_range=np.array(problem.scale_range),
        source_centre=frame.source_centre,
        target_centre=frame.target_centre,
        unit=frame.unit,
        start_lower=start.lower,
        start_upper=start.upper,
        leaf_lower=boxes.lower,
        leaf_upper=boxes.upper,
        # no more than the statement needs: larger bounds are expensive to prove again
        leaf_bounds=np.where(is_empty, np.inf, np.minimum(boxes.bounds, needed)),
        leaf_reasons=np.select([is_empty, is_open], [INADMISSIBLE, OPEN], PRUNED),
        theta=found.theta,
        lower_bound=lower_bound,
        upper_bound=found.upper_bound,
        gap_tol=gap_tol,
        candidates=np.empty((0, 2)) if pairs is None else np.argwhere(pairs),
        leaf_duals=duals,
        dual_units=units,
        **names,
    )


def _stored_duals(boxes: Boxes, model: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the duals of rigid poses in 4 bits, (L, m), and the exponents of their units, (L,)."""
    if model != "rigid3d" or boxes.warm_start is None:
        return np.empty((0, 0)), np.empty(0)
    duals = boxes.warm_start * DUAL_UNIT
    largest = duals.max(axis=1, initial=0.0)
    units = np.ceil(np.log2(np.maximum(largest, DUAL_UNIT) / LARGEST_DUAL)).astype(np.int8)
    return np.rint(np.ldexp(duals, -units[:, None].astype(np.int64))), units
