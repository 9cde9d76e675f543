"""The public functions that solve: `register`, `sweep` and `register_matches`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import register_problem
from dcreg.driver.sweep import sweep_problems
from dcreg.names import AUTO, DEFAULT_REL_GAP, DEFAULT_TIME_LIMIT_S, SCORES, SWEEP_SHARES
from dcreg.problem import Candidates, InputError, PointWeights, PoseRange, Problem
from dcreg.result import Result
from dcreg.sweep_result import SweepResult

if TYPE_CHECKING:
    from dcreg.problem.attributes import Attributes


def register(
    source: np.ndarray,
    target: np.ndarray,
    *,
    n_inliers: int | float | str = AUTO,
    model: str,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    pose_range: PoseRange | None = None,
    weights: PointWeights | None = None,
    attributes: Attributes | None = None,
    rel_gap: float = DEFAULT_REL_GAP,
    abs_gap: float | None = None,
    tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    max_rms: float | None = None,
    options: SolveOptions | None = None,
) -> Result:
    """Register two clouds without correspondences, with bounds on the global optimum.

    Minimises, over poses T of the model and one-to-one matchings P of exactly `n_inliers` pairs,
    ``sum_ij p_ij |T(x_i) - y_j|^2`` by branch and bound over the pose. The bounds in 2D are
    tighter forms of those of DC-Reg (arXiv 2603.25442). In 3D the default mode ``full`` has other bounds,
    of the pose. For ``rigid3d``, mode ``paper`` certifies only the translation, for the norm objective
    ``sum p_ij (|x_i + t| - |y_j|)^2``; a search for the rotation follows.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        d = 2 for ``similarity2d``, 3 for ``rigid3d`` and ``similarity3d``. In any unit of length.
    n_inliers : int, float or "auto"
        Number of pairs; a float in (0, 1] is a fraction of ``min(n, m)``. By default, the library chooses
        it by the residuals of poses found for several numbers; `Result.chosen_number` has the evidence.
        The choice is not proven: the bounds refer to the chosen number.
    model : {"similarity2d", "rigid3d", "similarity3d"}
    scale_range : (low, high), optional
        Admissible scale of a similarity; default (0.5, 1.5). Equal numbers fix the scale: ``(1, 1)``
        searches rotation and translation only.
    candidates : (n, m) bool array, or n sequences of target indices, optional
        The feasible pairs, e.g. from descriptors or a distance gate. All other pairs are excluded from
        the objective, the bounds and the assignment.
    pose_range : PoseRange, optional
        The admissible poses: rotations about one axis, limited angles or translations. Default: all.
    weights : PointWeights, optional
        Weights of the points. They replace the squared residual in the objective, the bounds and the
        covariance by the cost of `PointWeights`. Limits: at most 1,200,000 point pairs, and not in mode
        ``paper`` in 3D.
    attributes : Attributes, optional
        Colours, intensities or other attributes of the points. The objective and the bounds then include
        their differences, see `Attributes`. The limits are those of `weights`.
    rel_gap : float
        The relative tolerance, as a share of the upper bound, below 1. The search stops when
        ``upper_bound - lower_bound <= max(rel_gap * upper_bound, abs_gap)``.
    abs_gap : float, optional
        The absolute tolerance, in squared units of the target. A search with a sample reduces it in
        proportion to the number of pairs. Default and minimum: the rounding error of the objective,
        ``n_inliers * (1e-7 * RMS radius of the target)^2`` for moderate coordinates. A fit is exact if
        its objective is at most 100 times this error. If the fit is not exact, and `abs_gap` alone
        closes the gap while the lower bound is 0, the status is ``converged``.
    tol : float, optional
        `abs_gap` as a length, the RMS residual per pair in units of the target:
        ``abs_gap = n_inliers * tol^2``. Only one of the two can be given.
    time_limit : float, optional
        Seconds for the solve, 60 by default; None or inf: no limit. After the limit, the best pose is
        returned with status ``time_limit``. The delay is at most a tenth of the limit plus one second, or
        several seconds if the clouds have more than 100,000 points. The first search of each kind also
        compiles its kernels, which can take tens of seconds.
    node_limit : int, optional
        Maximum number of boxes bounded per stage. A round of up to two thousand boxes is completed.
    memory_limit_mb : float, optional
        Limit on the memory of the open boxes. While their storage is enlarged, it can take up to three
        times as much.
    max_rms : float, optional
        Decide whether a pose matches the `n_inliers` pairs with at most this RMS residual, in units of
        the target. The search ends as ``converged`` when such a pose is found, and as ``refuted`` when it
        is proven that there is none.
    options : SolveOptions, optional
        How to solve: mode, bound, threads, polish, certificate, downsampling, listener.

    Returns
    -------
    Result
        In the coordinates of the input.

    Raises
    ------
    InputError
        For bad input, before any search. The message names field and value, and says what to do.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((20, 2))
    >>> result = dcreg.register(points, points + 3.0, n_inliers=20, model="similarity2d")
    >>> result.status.value, np.round(result.translation, 6).tolist()
    ('optimal', [3.0, 3.0])
    """
    limits = Limits(rel_gap, abs_gap, tol, time_limit, node_limit, memory_limit_mb, max_rms)
    rest = model, scale_range, candidates, pose_range
    if not isinstance(n_inliers, str):
        problem = Problem(source, target, n_inliers, *rest, weights).with_attributes(attributes)
        return register_problem(problem, limits, SolveOptions.of(options))
    if n_inliers != AUTO:
        raise InputError(
            f"n_inliers: {n_inliers!r} is not a number; give a count, a fraction or {AUTO!r}"
        )
    given = {"weights": weights, "attributes": attributes}
    for name in (name for name, each in given.items() if each is not None):
        raise InputError(
            f"n_inliers: {name} need a number of pairs; run once without {name}, and give the number "
            "that the result states"
        )
    from dcreg.driver.auto import register_auto  # only if needed

    return register_auto(Problem(source, target, 1, *rest), limits, SolveOptions.of(options))


def sweep(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: Sequence[int | float] = SWEEP_SHARES,
    *,
    model: str,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    pose_range: PoseRange | None = None,
    weights: PointWeights | None = None,
    attributes: Attributes | None = None,
    rel_gap: float = DEFAULT_REL_GAP,
    abs_gap: float | None = None,
    tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    options: SolveOptions | None = None,
) -> SweepResult:
    """Register two clouds for several numbers of inliers, with bounds for each.

    Solves the problem of `dcreg.register` for each number of pairs. Searches share their poses. A bound
    for fewer pairs implies one for more pairs, also with `candidates`, and replaces a search if it is
    tight enough.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    n_inliers : sequence of int or float
        Numbers of pairs, in any order; repetitions are ignored. Floats in (0, 1] are fractions of
        ``min(n, m)``. Default: 0.2 to 1.0 in steps of 0.1.
    model, scale_range, candidates, pose_range, weights, attributes
        As in `dcreg.register`.
    rel_gap, abs_gap : optional
        For every number of pairs, as in `dcreg.register`.
    tol : float, optional
        `abs_gap` as a length, as in `dcreg.register`: ``abs_gap = k * tol^2`` for k pairs.
    time_limit : float, optional
        Seconds for all numbers of pairs together, 60 by default; None or inf: no limit. Time that one
        search leaves unused is given to the next ones. A result whose gap is open at the end has status
        ``time_limit``, with valid bounds and a pose.
    node_limit, memory_limit_mb : optional
        For each search.
    options : SolveOptions, optional
        As in `dcreg.register`, but a sweep keeps no certificate. The stages of events are named after
        the number of pairs (``k=40``) or ``rotation``. Numbers that become equal by downsampling have the
        same bounds.

    Returns
    -------
    SweepResult

    Raises
    ------
    InputError
        For bad input, before any search. The message names field and value, and says what to do.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> rng = np.random.default_rng(0)
    >>> points = rng.random((20, 2))
    >>> moved = points + 3.0 + 0.01 * rng.standard_normal((20, 2))
    >>> moved[16:] = rng.random((4, 2)) + 3.0  # outliers
    >>> found = dcreg.sweep(points, moved, [12, 14, 16, 18, 20], model="similarity2d")
    >>> found.status.value, [round(row["rms"], 2) for row in found.rows()]
    ('optimal', [0.01, 0.01, 0.01, 0.03, 0.11])
    """
    if isinstance(n_inliers, str) or not isinstance(n_inliers, Iterable):
        raise InputError(
            f"n_inliers: {n_inliers!r} is not a list; give several such as [0.5, 0.7, 0.9], or use "
            "register for one"
        )
    counts = list(n_inliers)
    if not counts:
        raise InputError("n_inliers: the list is empty; give at least one count or fraction")
    rest = model, scale_range, candidates, pose_range
    first = Problem(source, target, counts[0], *rest)
    numbers = sorted({first.with_n_inliers(count).n_inliers for count in counts})
    # weights that are valid for the smallest number are valid for larger ones
    fewest = Problem(source, target, numbers[0], *rest, weights).with_attributes(attributes)
    limits = Limits(rel_gap, abs_gap, tol, time_limit, node_limit, memory_limit_mb)
    problems = [fewest.with_n_inliers(k) for k in numbers]
    return sweep_problems(problems, limits, SolveOptions.of(options))


def register_matches(
    source: np.ndarray,
    target: np.ndarray,
    matches: np.ndarray,
    *,
    inlier_distance: float,
    score: str = SCORES[0],
    certify: bool | None = None,
    rel_gap: float = DEFAULT_REL_GAP,
    abs_gap: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    options: SolveOptions | None = None,
) -> Result:
    """Register two clouds in 3D over a list of matches, many of which may be wrong.

    Let N be the maximum number of matches that can be selected one-to-one. The cost of a pose with k
    selected matches is the sum of their squared residuals plus ``(N - k) inlier_distance^2``. This
    cost is minimised. An optimal pose with k matches is also optimal for `register` with the matches as
    feasible pairs and ``n_inliers = k``.

    Poses on which many compatible matches agree are refined first. Branch and bound over the rotation,
    with a nested search for the translation, then certifies the best one as far as the limits allow. Time
    and memory grow with the number of matches, not with the product of the sizes of the clouds.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    matches : (N, 2) int array
        Source row and target row of every match, the most likely ones first; a point may be in several
        matches. Initial poses use the first 5,000 matches.
    inlier_distance : float
        A match with a larger residual counts as wrong. In units of the clouds.
    score : {"correspondences", "surfaces"}
        How to select among the poses on which matches agree. ``correspondences``: by the cost above.
        ``surfaces``: by the score of the matches times that of the surfaces of both clouds (near points
        with similar normals) at the pose. The latter has a higher success rate for dense scans with
        partial overlap and is meaningless for sparse clouds. Its pose need not have minimum cost and is
        not certified.
    certify : bool, optional
        False: the pose only, with lower bound 0 and status ``converged``. True: search to the time limit
        for a proof. Default, for ``correspondences``: end after about 25 seconds at most
        if there is no proof.
    rel_gap, abs_gap : optional
        Tolerances on the gap of the cost, as in `dcreg.register`. Like `node_limit`, they affect only the
        certificate.
    time_limit : float, optional
        Seconds for the solve, 60 by default; None or inf: no limit.
    node_limit : int, optional
        Maximum number of boxes bounded.
    options : SolveOptions, optional
        Only `listener` may be set; other options are rejected.

    Returns
    -------
    Result
        `n_inliers` is the number of selected matches, `assignment` lists them, and `objective` is their
        sum of squared residuals. The bounds refer to the cost above; `score` converts them to a number of
        matches. `warnings` state what is not proven or not determined, and whether another pose agrees
        with the matches nearly as well.

    Raises
    ------
    InputError
        For bad input. The message names field and value, and says what to do.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((40, 3))
    >>> target = np.vstack([points[:20] + 3.0, points[:20]])  # the last 20 matches are wrong
    >>> matches = np.column_stack([np.arange(40), np.arange(40)])
    >>> result = dcreg.register_matches(points, target, matches, inlier_distance=0.02)
    >>> result.n_inliers, np.round(result.translation, 6).tolist()
    (20, [3.0, 3.0, 3.0])
    """
    # kernels that only this function needs
    from dcreg.driver.matching import register_match_problem
    from dcreg.families.matches.problem import MatchProblem

    problem = MatchProblem.checked(source, target, matches, inlier_distance)
    limits = Limits(rel_gap, abs_gap, None, time_limit, node_limit)
    return register_match_problem(problem, score, certify, limits, SolveOptions.of(options))
