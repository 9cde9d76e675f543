"""`register`: from two clouds to a certified pose. Composes model, bound, search and polish."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dcreg.bounds import bound_parts, make_bound
from dcreg.box import Box, LongestEdge
from dcreg.certificate import Certificate, of_search
from dcreg.frame import Frame
from dcreg.models import Model, Similarity2D, Translation3D
from dcreg.polish import objective, polish
from dcreg.problem import Candidates, InputError, Problem, default_gap_tol
from dcreg.result import Result, Status
from dcreg.rigid import RigidResult, search_multi, search_rigid
from dcreg.rotation import search_rotation
from dcreg.sampling import search_sampled_rotation
from dcreg.search import Leaves, Limits, SearchResult, branch_and_bound
from dcreg.sparse import is_large, sparse_matching
from dcreg.trace import Event, Listener, Trace

# A dense cost matrix beyond this many pairs does not fit the memory of a common machine.
MAX_PAIRS = 100_000_000
# In norm space these match sorted numbers and need no cost matrix.
MATRIX_FREE_BOUNDS = {"tight", "tight-exact", "shared"}
# Share of the time limit that the translation search may use before the rotation gets its turn.
TRANSLATION_SHARE = 0.8


@dataclass
class Solve:
    """What the stages of one mode share: settings in, pose and bounds out (normalised units)."""

    source: np.ndarray
    target: np.ndarray
    problem: Problem
    bound: str
    start_box: str
    gap_tol: float
    limits: Limits
    threads: int
    listener: Listener | None
    status: Status = Status.FAILED
    T: np.ndarray = field(default_factory=lambda: np.empty(0))
    lower_bound: float = 0.0
    upper_bound: float = np.inf
    scope: str = ""
    n_nodes: int = 0
    n_assignments: int = 0
    n_bound_evals: int = 0
    stages: list[dict[str, Any]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    leaves: Leaves | None = None  # filled by the search when a certificate is asked for
    found: SearchResult | None = None
    start: Box | None = None

    def search(self, model: Model, limits: Limits) -> SearchResult:
        """Algorithm 1 over `model` with this solve's bound."""
        bound = make_bound(self.bound, model, self.threads)
        theta, value, spent = model.first_incumbent()
        self.n_assignments += spent
        self.start = model.start_box()
        found = branch_and_bound(
            bound,
            [self.start],
            branching=LongestEdge(model.axis_weights),
            gap_tol=self.gap_tol,
            refine=model.refine,
            start=(theta, value),
            limits=limits,
            round_size=_round_size(len(self.source) * len(self.target)),
            listener=self.listener,
            leaves=self.leaves,
        )
        self.found = found
        self.status = found.status
        self.lower_bound, self.upper_bound = found.lower_bound, found.upper_bound
        self.scope = model.scope
        self._account("search", found, found.events)
        return found

    def rotate(self, shifted: np.ndarray, time_s: float | None) -> np.ndarray:
        """Best rotation of the shifted source: the second stage in 3D.

        Large clouds get a sampled one; it claims nothing, so that the status stays the translation's.
        """
        if self.problem.candidates is None and is_large(len(shifted), len(self.target)):
            sampled = search_sampled_rotation(
                shifted,
                self.target,
                self.problem.n_inliers,
                gap_tol=self.gap_tol,
                time_limit=time_s,
            )
            self._account("rotation", sampled, sampled.events)
            return sampled.rotation
        found = search_rotation(
            shifted,
            self.target,
            self.problem.n_inliers,
            gap_tol=self.gap_tol,
            time_limit=time_s,
            node_limit=self.limits.nodes,
            candidates=self.problem.candidates,
            listener=self.listener,
        )
        if self.status is Status.OPTIMAL:
            self.status = found.status
        self._account("rotation", found, found.events)
        return found.rotation

    def rigid(self, search: Callable[..., RigidResult], stage: str) -> None:
        """Run a search that ends with the whole rigid pose."""
        found = search(
            self.source,
            self.target,
            self.problem.n_inliers,
            gap_tol=self.gap_tol,
            limits=self.limits,
            threads=self.threads,
            listener=self.listener,
            start_box=self.start_box,
            candidates=self.problem.candidates,
        )
        self.T, self.status, self.scope = found.T, found.status, found.scope
        self.lower_bound, self.upper_bound = found.lower_bound, found.upper_bound
        self._account(stage, found, found.events)

    def _account(self, stage: str, found: Any, events: list[Event]) -> None:
        self.stages.append(
            {
                "stage": stage,
                "status": found.status.value,
                "lower_bound": found.lower_bound,
                "upper_bound": found.upper_bound,
                "n_nodes": found.n_nodes,
                "n_assignments": found.n_assignments,
                "time_s": found.time_s,
            }
        )
        self.n_nodes += found.n_nodes
        self.n_assignments += found.n_assignments
        self.n_bound_evals += found.n_nodes
        offset = self.events[-1].time_s if self.events else 0.0
        self.events += [dataclasses.replace(e, time_s=e.time_s + offset) for e in events]


def _similarity2d(solve: Solve) -> None:
    model = Similarity2D(
        solve.source,
        solve.target,
        solve.problem.n_inliers,
        solve.problem.scale_range,
        reduced_box=solve.start_box == "reduced",
        candidates=solve.problem.candidates,
    )
    found = solve.search(model, solve.limits)
    solve.T = model.pose(found.theta)


def _rigid3d_paper(solve: Solve) -> None:
    """The paper's two stages: one translation in norm space, then the rotation about the origin."""
    model = Translation3D(
        solve.source,
        solve.target,
        solve.problem.n_inliers,
        reduced_box=solve.start_box == "reduced",
        candidates=solve.problem.candidates,
    )
    time_s = solve.limits.time_s
    limits = dataclasses.replace(solve.limits, time_s=time_s and TRANSLATION_SHARE * time_s)
    began = time.perf_counter()
    found = solve.search(model, limits)
    left = None if time_s is None else max(0.0, time_s - (time.perf_counter() - began))
    rotation = solve.rotate(solve.source + found.theta, left)
    solve.T = np.eye(4)
    solve.T[:3, :3] = rotation
    solve.T[:3, 3] = rotation @ found.theta


def _rigid3d_full(solve: Solve) -> None:
    """The true rigid objective over translation and rotation at once; certifies the pose."""
    solve.bound = "rigid"  # this search has its own bounds, see `dcreg.rigid`
    solve.rigid(search_rigid, "rigid")


def _rigid3d_multi(solve: Solve) -> None:
    """The paper's two stages from every near-optimal translation; the best rigid objective wins."""
    solve.rigid(functools.partial(search_multi, bound=solve.bound), "multi")


# mode -> pipeline; without a name `choose_mode` takes one
MODES: dict[str, dict[str, Callable[[Solve], None]]] = {
    "similarity2d": {"paper": _similarity2d},
    "rigid3d": {"paper": _rigid3d_paper, "multi": _rigid3d_multi, "full": _rigid3d_full},
}
# These end with a leaf cover that `dcreg.verification` can check.
CERTIFIABLE = {"similarity2d": ("paper", "similarity2d"), "rigid3d": ("paper", "translation3d")}
DEFAULT_BOUND = "tight"
START_BOXES = ("reduced", "safe")
AUTO = "auto"
# Mode `full` closes on this many pairs in seconds, whatever the outliers.
FULL_PAIRS = 1_600
# Beyond this a single box of modes `full` and `multi` takes seconds.
RIGID_PAIRS = 160_000


def register(
    source: np.ndarray,
    target: np.ndarray,
    *,
    n_inliers: int | float,
    model: str,
    mode: str | None = None,
    bound: str = DEFAULT_BOUND,
    start_box: str = START_BOXES[0],
    scale_range: tuple[float, float] = (0.5, 1.5),
    gap_tol: float | None = None,
    time_limit: float | None = None,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    threads: int = 1,
    candidates: Candidates | None = None,
    polish: bool = True,
    certificate: bool = False,
    listener: Listener | None = None,
) -> Result:
    """Register two clouds without correspondences, globally and with a certificate.

    Minimises, over poses T of the model and one-to-one matchings P of exactly `n_inliers` pairs,
    ``sum_ij p_ij |T(x_i) - y_j|^2`` by branch and bound over the pose (DC-Reg, arXiv 2603.25442).
    In 3D the paper's mode certifies the translation of the norm objective
    ``sum p_ij (|x_i + t| - |y_j|)^2`` and recovers the rotation after it.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        d = 2 for ``similarity2d``, 3 for ``rigid3d``. In any unit of length.
    n_inliers : int or float
        Pairs to match; a float in (0, 1] is a fraction of ``min(n, m)``.
    model : {"similarity2d", "rigid3d"}
    mode : str, optional
        Pipeline of the model, see `MODES`; default `choose_mode`'s. `Result.mode` tells which ran,
        `Result.certificate_scope` what its bounds speak of.
    bound : str
        Bounding function, see `dcreg.bounds.bound_names`; ``a+b`` takes the greater one.
    start_box : {"reduced", "safe"}
        Both hold every optimum. ``safe`` follows from the radii of the clouds alone; ``reduced``
        uses that an optimal pose is stationary, so its translation is a difference of means of
        `n_inliers` points (a single value when all points match).
    scale_range : (low, high)
        Admissible scale, 2D only.
    gap_tol : float, optional
        Absolute tolerance on the gap of the objective, in squared units of the target; default
        ``n_inliers * (0.03 * RMS radius of the target)^2``.
    time_limit : float, optional
        Seconds for the solve. The best pose so far is returned with status ``time_limit``.
    node_limit : int, optional
        Boxes bounded per stage.
    memory_limit_mb : float, optional
        Memory of the open boxes.
    threads : int
        Threads that evaluate bounds; the result does not depend on it.
    candidates : (n, m) bool array, or n sequences of target indices, optional
        The feasible pairs, e.g. from descriptors or a distance gate; all others are ruled out in the
        objective, the bounds and the answer.
    polish : bool
        Refine the final pose locally on the full objective. Reported apart from the certificate.
    certificate : bool
        Keep the leaf boxes of the search as `Result.certificate`, for `dcreg.verification.verify`.
        Modes ``paper`` only; in 3D it certifies the translation.
    listener : callable, optional
        Called with every `dcreg.trace.Event`; returning True stops (status ``stopped``).

    Returns
    -------
    Result
        In the coordinates of the input.

    Raises
    ------
    InputError
        For bad input, before any search, naming field, value and remedy.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((20, 2))
    >>> result = dcreg.register(points, points + 3.0, n_inliers=20, model="similarity2d")
    >>> result.status.value, np.round(result.translation, 6).tolist()
    ('optimal', [3.0, 3.0])
    """
    began = time.perf_counter()
    problem = Problem(source, target, n_inliers, model, scale_range, candidates)
    if mode is None or mode == AUTO:
        mode = choose_mode(problem, bound, certificate)
    if mode not in MODES[model]:
        raise InputError(
            f"mode: {mode!r} is unknown for {model}; choose from {[AUTO, *MODES[model]]}"
        )
    if certificate and mode != CERTIFIABLE[model][0]:
        raise InputError(f"certificate: mode {mode!r} keeps no leaf boxes; use mode 'paper'")
    bound_parts(bound)  # unknown names end here, also where a mode has bounds of its own
    check_size(problem, matrix_free=_is_matrix_free(problem, mode, bound))
    if start_box not in START_BOXES:
        raise InputError(f"start_box: {start_box!r} is unknown; choose from {list(START_BOXES)}")
    if gap_tol is None:  # a target without extent is measured by the source
        gap_tol = default_gap_tol(problem.target, problem.n_inliers) or default_gap_tol(
            problem.source, problem.n_inliers
        )
    _check_settings(
        gap_tol=gap_tol, time_limit=time_limit, node_limit=node_limit,
        memory_limit_mb=memory_limit_mb, threads=threads,
    )  # fmt: skip
    frame = Frame.of(problem)
    area = frame.unit**2
    _warm_up(model, mode, bound)
    time_setup = time.perf_counter() - began

    began = time.perf_counter()
    solve = Solve(
        frame.source(problem.source),
        frame.target(problem.target),
        problem,
        bound,
        start_box,
        gap_tol / area,
        Limits(time_limit, node_limit, memory_limit_mb),
        threads,
        _in_file_units(listener, area),
        leaves=Leaves() if certificate else None,
    )
    MODES[model][mode](solve)
    T_certified = frame.pose(solve.T)
    deadline = None if time_limit is None else began + time_limit
    value, pairs = objective(
        problem.source,
        problem.target,
        T_certified,
        problem.n_inliers,
        problem.candidates,
        prove=not polish,
    )
    final_T, final_value = T_certified, value
    if polish:
        polish_began = time.perf_counter()
        final_T, final_value, pairs, spent = _polish(problem, T_certified, deadline)
        solve.stages.append(
            {
                "stage": "polish",
                "objective_before": value,
                "objective_after": final_value,
                "n_assignments": spent,
                "time_s": time.perf_counter() - polish_began,
            }
        )
    return Result(
        status=solve.status,
        model=model,
        mode=mode,
        bound=solve.bound,
        T_target_source=final_T,
        T_certified=T_certified,
        assignment=pairs,
        n_inliers=problem.n_inliers,
        lower_bound=solve.lower_bound * area,
        upper_bound=solve.upper_bound * area,
        gap_tol=gap_tol,
        certificate_scope=solve.scope,
        objective=final_value,
        objective_certified=value,
        n_nodes=solve.n_nodes,
        n_assignments=solve.n_assignments,
        n_bound_evals=solve.n_bound_evals,
        time_setup_s=time_setup,
        time_solve_s=time.perf_counter() - began,
        trace=Trace([_scaled(event, area) for event in solve.events]),
        stages=[_stage_in_file_units(stage, area) for stage in solve.stages],
        certificate=_certificate(solve, frame, mode),
    )


def choose_mode(problem: Problem, bound: str = DEFAULT_BOUND, certificate: bool = False) -> str:
    """The mode that gives the best pose for the time.

    ``full`` where it closes within seconds: all points match, or few pairs; else ``multi``, which ends
    by itself and tries the same first poses. ``paper`` where only it will do: for certificates, a
    bound other than the default, and large clouds.
    """
    n, m = len(problem.source), len(problem.target)
    only_paper = certificate or bound != DEFAULT_BOUND
    if problem.model == "similarity2d" or only_paper or n * m > RIGID_PAIRS:
        return "paper"
    return "full" if problem.n_inliers == n == m or n * m <= FULL_PAIRS else "multi"


def check_size(problem: Problem, *, matrix_free: bool = False) -> None:
    """Refuse clouds whose cost matrix would not fit the memory of a common machine."""
    n, m = len(problem.source), len(problem.target)
    if n * m > MAX_PAIRS and not matrix_free:
        remedy = "downsample both clouds first (a voxel grid or farthest points)"
        if problem.dim == 3:
            remedy += f", or use mode 'paper' with bound {DEFAULT_BOUND!r} and without candidates"
        raise InputError(f"source, target: {n} x {m} pairs exceed {MAX_PAIRS:,}; {remedy}")


def _is_matrix_free(problem: Problem, mode: str, bound: str) -> bool:
    return (
        problem.dim == 3
        and mode == "paper"
        and problem.candidates is None
        and MATRIX_FREE_BOUNDS.issuperset(bound_parts(bound))
    )


def _certificate(solve: Solve, frame: Frame, mode: str) -> Certificate | None:
    if solve.leaves is None or solve.found is None or solve.start is None:
        return None
    problem = solve.problem
    return of_search(
        solve.found,
        solve.leaves,
        solve.start,
        frame,
        problem.source,
        problem.target,
        model=CERTIFIABLE[problem.model][1],
        mode=mode,
        bound=solve.bound,
        n_inliers=problem.n_inliers,
        scale_range=problem.scale_range,
        gap_tol=solve.gap_tol,
        candidates=problem.candidates,
    )


def _polish(
    problem: Problem, T: np.ndarray, deadline: float | None = None
) -> tuple[np.ndarray, float, np.ndarray, int]:
    return polish(
        problem.source,
        problem.target,
        T,
        problem.n_inliers,
        problem.scale_range,
        problem.candidates,
        deadline,
    )


def _check_settings(**settings: float | None) -> None:
    for name, value in settings.items():
        if value is None:
            continue
        least = 1 if name in ("node_limit", "threads") else 0
        if not np.isfinite(value) or value < least or (name == "time_limit" and value == 0):
            raise InputError(f"{name}: {value} is not a usable value; give a positive number")


def _round_size(n_pairs: int) -> int:
    """Boxes per round: enough to keep threads busy, few enough to stay interruptible."""
    return int(np.clip(8_000_000 // n_pairs, 1, 256))


def _scaled(event: Event, area: float) -> Event:
    return dataclasses.replace(
        event, lower_bound=event.lower_bound * area, upper_bound=event.upper_bound * area
    )


def _stage_in_file_units(stage: dict[str, Any], area: float) -> dict[str, Any]:
    return {k: v * area if k in ("lower_bound", "upper_bound") else v for k, v in stage.items()}


def _in_file_units(listener: Listener | None, area: float) -> Listener | None:
    if listener is None:
        return None
    return lambda event: listener(_scaled(event, area))


def warm_up() -> None:
    """Compile every kernel into the on-disk cache, so that no later process waits for it."""
    for model, modes in MODES.items():
        for mode in modes:
            for bound in (DEFAULT_BOUND, "paper", "edges"):
                _warm_up(model, mode, bound)
    _warm_up("similarity2d", "paper", "termwise")
    points = np.random.default_rng(0).standard_normal((20, 3))
    search_sampled_rotation(points, points, 20, gap_tol=0.0)
    sparse_matching(points, points, 15)


@functools.cache
def _warm_up(model: str, mode: str, bound: str) -> None:
    """Compile (or load from cache) every kernel of a mode on a tiny problem, once a process."""
    generator = np.random.default_rng(0)
    points = generator.standard_normal((8, 2 if model == "similarity2d" else 3))
    for n_inliers in (6, 8):  # both assignment solvers
        problem = Problem(points, points[:, ::-1].copy(), n_inliers, model)
        MODES[model][mode](
            Solve(points, problem.target, problem, bound, "safe", 0.5, Limits(nodes=8), 1, None)
        )
        _polish(problem, np.eye(points.shape[1] + 1))
