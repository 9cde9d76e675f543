"""How to solve a problem: options, tolerance and limits."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from dcreg.names import DEFAULT_REL_GAP, START_BOXES
from dcreg.problem.errors import InputError, suggestion
from dcreg.problem.geometry import error_of_sum
from dcreg.search import Budget, Listener, Tolerance

MAX_DEFAULT_THREADS = 8  # more make few searches faster, and the machine serves others as well
MAX_THREADS = 1024
SMALLEST = np.nextafter(0.0, 1.0)  # positive number


def usable_processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class SolveOptions:
    """How `dcreg.register`, `dcreg.sweep` and `dcreg.register_matches` solve a problem.

    Attributes
    ----------
    mode : str, optional
        Search mode, one of `dcreg.mode_names`; default: the library selects it. `Result.mode` gives the
        mode that ran, and `Result.certificate_scope` what its bounds refer to.
    bound : str, optional
        Bounding function, which computes the lower bounds, one of `dcreg.bound_names`; ``a+b`` takes the
        maximum of two. Default: ``tight``, with the stage ``distances`` in 2D; a bound that is
        given works alone. Mode ``full`` has its own bounds and accepts none.
    start_box : {"stationary", "radius"}
        Box in which the search starts; both contain every optimum. ``radius`` follows only from the radii
        of the clouds. ``stationary`` uses the fact that an optimal pose is stationary: its translation is
        a difference of means of `n_inliers` points (a single value if all points match).
    threads : int, optional
        Threads of the search; default: one for each processor that the process may use, at most
        `MAX_DEFAULT_THREADS`. They change the result only if elapsed time ends a step of
        the search; the bounds are valid in any case. With more
        than 40,000 point pairs, the initial poses use two threads; neighbour queries of large clouds use
        all processors.
    polish : bool
        Refine the final pose locally on the full objective. The result reports this separately from the
        certificate.
    certificate : bool
        Keep the leaf boxes of the search as `Result.certificate`, for `dcreg.verify`. The search then
        continues to its limits, as with `prove`. In 3D, mode ``full`` certifies the rigid pose; by
        default it is selected up to 160,000 point pairs. Mode ``paper`` certifies the translation in norm
        space.
    downsample : int, optional
        Search with at most this many points of each cloud, chosen by farthest-point sampling after
        outlier removal, and refine the pose on all points. An integer `n_inliers` refers to the full
        clouds and is scaled down with them. By default, all points are searched, except for large clouds
        if no mode, bound, certificate, candidates, weights, attributes or `max_rms` is given: 300 points
        in 2D above 1,000,000 point pairs; 400 points in 3D if both clouds have more than 1,000 points, or
        above 4,000,000 point pairs.
    prove : bool
        Search to the time limit for a proof. By default, mode ``full`` and searches of samples give up
        early and end as ``converged``: after about five seconds of one thread (25 if the initial poses
        are not confirmed), and after half a second at most for a sample. Sweeps over all points, and
        searches with a limit on boxes or assignments, continue to their limits.
    assignment_limit : int, optional
        Maximum number of exact assignments of each search, including those of the initial poses. In
        contrast to a time limit it gives the same result on every machine. The choice of `n_inliers` is
        not counted; only the time limit ends it.
    init : (d+1, d+1) array, optional
        An initial guess of the pose, from which an additional local search starts. It gives an early
        upper bound and does not restrict the search (`PoseRange` does). If the library chooses
        `n_inliers`, the choice starts from this pose, and the search from the pose that the choice found.
    checkpoint : path, optional
        A file in which `dcreg.register` saves the state of its search every two minutes and at its end.
        If the file exists, the search continues from it; the problem and the options that change the
        search must be the same. The time limit applies to each call, `node_limit` and
        `assignment_limit` apply to all calls together. Not available in mode ``paper`` in 3D, nor with a
        `PoseRange` that has a maximum angle or translation.
    listener : callable, optional
        Called with every `dcreg.Event`. If none occurs for a quarter of a second, it is called with an
        event of kind ``heartbeat`` from another thread. If it returns True, the solve stops with status
        ``stopped``.

    Raises
    ------
    InputError
        For an unknown start box, a wrong number of threads, a switch that is not a bool, a checkpoint
        that is not a path, or a listener that cannot be called.
    """

    mode: str | None = None
    bound: str | None = None
    start_box: str = START_BOXES[0]
    threads: int | None = None
    polish: bool = True
    certificate: bool = False
    downsample: int | None = None
    prove: bool = False
    assignment_limit: int | None = None
    init: Any = None
    checkpoint: str | os.PathLike[str] | None = None
    listener: Listener | None = None

    def __post_init__(self) -> None:
        if self.start_box not in START_BOXES:
            raise InputError(
                f"start_box: {self.start_box!r} is unknown{suggestion(self.start_box, START_BOXES)}"
            )
        check_positive("threads", self.threads, such_as=4)
        if (self.threads or 1) > MAX_THREADS:
            raise InputError(
                f"threads: {self.threads} threads are too many; give at most {MAX_THREADS}"
            )
        check_positive("assignment_limit", self.assignment_limit, such_as=100_000)
        for name in ("polish", "certificate", "prove"):
            if not isinstance(value := getattr(self, name), bool | np.bool_):
                raise InputError(f"{name}: {value!r} is not a bool; give True or False")
        if not isinstance(self.checkpoint, str | os.PathLike | None):
            raise InputError(
                f"checkpoint: {self.checkpoint!r} is not a path; give one such as 'a.npz'"
            )
        if not (self.listener is None or callable(self.listener)):
            raise InputError(
                f"listener: {self.listener!r} cannot be called; give a function of one dcreg.Event"
            )

    @property
    def n_threads(self) -> int:
        """Threads of the search."""
        return self.threads or min(usable_processors(), MAX_DEFAULT_THREADS)

    @property
    def must_prove(self) -> bool:
        """Whether the search continues to its limits; a certificate without a proof is of no use."""
        return self.prove or self.certificate

    def refuse_checkpoint(self) -> None:
        """Refuse a checkpoint, for a function that saves none.

        Raises
        ------
        InputError
        """
        if self.checkpoint is not None:
            raise InputError("checkpoint: only register and certify save one; omit it")

    @classmethod
    def of(cls, given: SolveOptions | None) -> SolveOptions:
        """Return the options given, or the default ones.

        Raises
        ------
        InputError
            For anything else, such as a dictionary.
        """
        if given is None:
            return cls()
        if not isinstance(given, cls):
            raise InputError(
                f"options: {given!r} is not a SolveOptions; give one such as "
                "dcreg.SolveOptions(downsample=200)"
            )
        return given


@dataclass(frozen=True)
class Limits:
    """Tolerances and limits of a solve; None is the default tolerance, or no limit.

    Attributes
    ----------
    rel_gap : float
    abs_gap, tol : float, optional
        See `dcreg.register`.
    time_s : float, optional
    nodes : int, optional
    memory_mb : float, optional
    max_rms : float, optional
        See `dcreg.register`.
    """

    rel_gap: float = DEFAULT_REL_GAP
    abs_gap: float | None = None
    tol: float | None = None
    time_s: float | None = None
    nodes: int | None = None
    memory_mb: float | None = None
    max_rms: float | None = None

    def check(self, n_inliers: int) -> None:
        """Refuse limits and tolerances that make no sense.

        Raises
        ------
        InputError
        """
        check_positive("rel_gap", self.rel_gap, minimum=0.0, optional=False)
        if self.rel_gap >= 1.0:
            raise InputError(
                f"rel_gap: {self.rel_gap} is not below 1; give a share of the upper bound, such as 0.01"
            )
        check_positive("abs_gap", self._abs_gap(n_inliers), minimum=0.0)
        if self.time_s != np.inf:
            check_positive("time_limit", self.time_s)
        check_positive("node_limit", self.nodes, such_as=10_000)
        check_positive("memory_limit_mb", self.memory_mb)
        check_positive("max_rms", self.max_rms)

    def tolerance(
        self, n_inliers: int, rounding: float, exact: float, share: float = 1.0, bits: float = 0.0
    ) -> Tolerance:
        """Return the tolerance of a search.

        Parameters
        ----------
        n_inliers : int
            Pairs of the problem as given.
        rounding : float
            Rounding error of the objective: the default of `abs_gap`, and its minimum.
        exact : float
            The objective up to which a fit counts as exact.
        share : float
            Share of these pairs that is searched. A sample gets this share of `abs_gap`.
        bits : float
            Rounding error of a residual.
        """
        abs_gap = max(share * (self._abs_gap(n_inliers) or 0.0), rounding)
        # an exact fit has a residual of 0 up to rounding
        target = None if self.max_rms is None else max(n_inliers * self.max_rms**2, exact)
        margin = 0.0 if target is None else error_of_sum(target, n_inliers, bits)
        return Tolerance(self.rel_gap, abs_gap, exact, target, margin)

    def _abs_gap(self, n_inliers: int) -> float | None:
        """Return the absolute tolerance, which may be given as a length per pair."""
        tol = self.tol
        if tol is None:
            return self.abs_gap
        if self.abs_gap is not None:
            raise InputError(
                f"tol: {tol}, and abs_gap: {self.abs_gap} as well; give one of them "
                "(abs_gap = K * tol^2)"
            )
        is_number = isinstance(tol, int | float | np.number) and not isinstance(tol, bool)
        if not (is_number and tol >= 0 and np.isfinite(n_inliers * tol * tol)):
            raise InputError(
                f"tol: {tol!r} is not a usable value; give a length in units of the target, such as 0.01"
            )
        return float(n_inliers * tol * tol)

    def budget(self, options: SolveOptions, listener: Listener | None) -> Budget:
        """Start the clock."""
        return Budget(self.time_s, self.nodes, self.memory_mb, listener, options.assignment_limit)


def check_positive(
    name: str,
    value: float | None,
    *,
    minimum: float = SMALLEST,
    such_as: int | None = None,
    optional: bool = True,
) -> None:
    """Refuse a setting that is no finite number of at least `minimum`.

    Parameters
    ----------
    name : str
    value : float or None
    minimum : float
    such_as : int, optional
        An example, if the number has to be whole.
    optional : bool
        Accept None.

    Raises
    ------
    InputError
    """
    if optional and value is None:
        return
    kinds = int | float | np.number if such_as is None else int | np.integer
    remedies = {0.0: "give 0 or a positive number", SMALLEST: "give a positive number"}
    remedy = remedies.get(minimum, f"give a number of at least {minimum:.3g}")
    if isinstance(value, bool) or not isinstance(value, kinds):
        needed = f"a number; {remedy}"
        if such_as is not None:
            needed = f"a whole number; give one such as {such_as}"
        raise InputError(f"{name}: {value!r} is not {needed}")
    if not minimum <= value < np.inf:
        raise InputError(f"{name}: {value} is not a usable value; {remedy}")
