"""Options of a solve that say how to solve, not what."""

from __future__ import annotations

from dataclasses import dataclass

from dcreg.problem.problem import InputError, suggestion
from dcreg.search import Listener

START_BOXES = ("stationary", "radius")


@dataclass(frozen=True)
class SolveOptions:
    """How `dcreg.register`, `dcreg.sweep` and `dcreg.register_matches` solve a problem.

    Attributes
    ----------
    mode : str, optional
        Search mode, one of `dcreg.mode_names`; default: the library chooses. `Result.mode` gives the mode
        that ran, `Result.certificate_scope` what its bounds refer to.
    bound : str, optional
        Lower bounding function, one of `dcreg.bound_names`; ``a+b`` takes the greater one. Default:
        ``tight``. Mode ``full`` has its own bounds and accepts none.
    start_box : {"stationary", "radius"}
        Both contain every optimum. ``radius`` follows from the radii of the clouds alone. ``stationary``
        uses that an optimal pose is stationary, so that its translation is a difference of means of
        `n_inliers` points (a single value when all points match).
    threads : int
        Threads that evaluate bounds. The result does not depend on their number.
    polish : bool
        Refine the final pose locally on the full objective. The result reports this separately from the
        certificate.
    certificate : bool
        Keep the leaf boxes of the search as `Result.certificate`, for `dcreg.verify`. Mode ``paper``
        only; in 3D the certificate covers the translation.
    downsample : int, optional
        Search with at most this many points of each cloud, chosen by farthest-point sampling after
        outlier removal, and refine the pose on all points. An integer `n_inliers` refers to the full
        clouds and is scaled down with them. Default, if neither mode, bound, certificate nor candidates
        are given: 300 in 2D above 1,000,000 pairs of points, 1,000 in 3D above 4,000,000 pairs of clouds
        that match in part; all points otherwise.
    listener : callable, optional
        Called with every `dcreg.Event`, and at least every half second, then from another thread. If it
        returns True the solve stops with status ``stopped``.

    Raises
    ------
    InputError
        For an unknown start box.
    """

    mode: str | None = None
    bound: str | None = None
    start_box: str = START_BOXES[0]
    threads: int = 1
    polish: bool = True
    certificate: bool = False
    downsample: int | None = None
    listener: Listener | None = None

    def __post_init__(self) -> None:
        if self.start_box not in START_BOXES:
            raise InputError(
                f"start_box: {self.start_box!r} is unknown{suggestion(self.start_box, START_BOXES)}"
            )
