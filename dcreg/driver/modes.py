"""The table of modes. A mode refuses what it would ignore."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dcreg.driver.full import run as run_full
from dcreg.driver.multi import run as run_multi
from dcreg.driver.paper import run as run_paper
from dcreg.driver.task import Answer, Task
from dcreg.families.registry import bound_parts
from dcreg.names import AUTO, DEFAULT_BOUND, mode_names
from dcreg.problem import (
    TOLERATED_NORM_RESIDUAL,
    TOLERATED_RESIDUAL,
    InputError,
    Problem,
    suggestion,
)

# A dense cost matrix beyond this many pairs does not fit the memory of a common machine.
MAX_PAIRS = 100_000_000
# In norm space these match sorted numbers and need no cost matrix.
MATRIX_FREE_BOUNDS = {"tight", "shared"}
# By dimension: pairs beyond which a sample is searched instead, and the points of each cloud in it. In
# the plane searches of some hundred come to their end, and of thousands not one descent does; in space a
# single assignment of mode `full` takes seconds.
LARGE_PAIRS = {2: 1_000_000, 3: 4_000_000}
LARGE_SAMPLE = {2: 300, 3: 1_000}


@dataclass(frozen=True)
class Mode:
    """One way from a problem to a pose.

    Attributes
    ----------
    name, model : str
        The same name may serve several models.
    run : callable
    takes_bound : bool
        Whether the bounding function can be chosen; otherwise the mode has its own, `own_bound`.
    tolerated : float
        RMS residual per pair that the default tolerance allows, in RMS radii of the target.
    certifies : str
        Family of the certificate its search can record (``dcreg.certificate.format.MODELS``), or
        empty.
    summary : str
        One line for help texts and manuals.
    """

    name: str
    model: str
    run: Callable[[Task], Answer]
    summary: str
    takes_bound: bool = True
    own_bound: str = DEFAULT_BOUND
    certifies: str = ""
    tolerated: float = TOLERATED_RESIDUAL

    @property
    def in_norm_space(self) -> bool:
        """Whether its bounds speak of norms, not of the residuals of a pose."""
        return self.tolerated == TOLERATED_NORM_RESIDUAL

    def check(self, problem: Problem, bound: str | None, certificate: bool) -> None:
        """Refuse settings that this mode would ignore, and clouds it cannot hold.

        Raises
        ------
        InputError
        """
        if bound is not None:
            bound_parts(bound)  # unknown names end here
            if not self.takes_bound:
                raise InputError(
                    f"bound: {bound!r}, but mode {self.name!r} has bounds of its own; leave the bound "
                    "out, or choose mode 'paper'"
                )
        if certificate and not self.certifies:
            raise InputError(
                f"certificate: mode {self.name!r} keeps no leaf boxes; use mode 'paper'"
            )
        n, m = len(problem.source), len(problem.target)
        if n * m > MAX_PAIRS and not self._is_matrix_free(problem, bound):
            remedy = "downsample both clouds first (downsample=200, or --downsample 200)"
            if problem.dim == 3:
                remedy += (
                    f", or use mode 'paper' with bound {DEFAULT_BOUND!r} and without candidates"
                )
            raise InputError(f"source, target: {n} x {m} pairs exceed {MAX_PAIRS:,}; {remedy}")

    def _is_matrix_free(self, problem: Problem, bound: str | None) -> bool:
        return (
            self.certifies == "translation3d"
            and problem.candidates is None
            and MATRIX_FREE_BOUNDS.issuperset(bound_parts(bound or self.own_bound))
        )


MODES = (
    Mode(
        "paper", "similarity2d", run_paper,
        "the similarity, searched as in the paper; certifies the pose",
        certifies="similarity2d",
    ),
    Mode(
        "full", "rigid3d", run_full,
        "translation and rotation searched together; certifies the rigid pose",
        takes_bound=False, own_bound="rigid",
    ),
    Mode(
        "multi", "rigid3d", run_multi,
        "every near-optimal translation gets its rotation search; certifies the norm objective",
        tolerated=TOLERATED_NORM_RESIDUAL,
    ),
    Mode(
        "paper", "rigid3d", run_paper,
        "the paper's two stages: one translation in norm space, then its rotation",
        certifies="translation3d", tolerated=TOLERATED_NORM_RESIDUAL,
    ),
)  # fmt: skip


def find_mode(model: str, name: str) -> Mode:
    """The mode called `name`.

    Raises
    ------
    InputError
        For an unknown name, listing the known ones.
    """
    for mode in MODES:
        if (mode.model, mode.name) == (model, name):
            return mode
    raise InputError(
        f"mode: {name!r} is unknown for {model}{suggestion(name, [AUTO, *mode_names(model)])}"
    )


# What `choose_mode` chooses among.
CHOSEN = ("full", "paper")


def choose_mode(problem: Problem, bound: str | None = None, certificate: bool = False) -> str:
    """The mode that gives the best pose for the time.

    In 3D ``full``: over shapes, disturbances, sizes and limits none is right more often (``make modes``
    measures it). ``paper`` where only it will do: for certificates, a bound that was asked for, and large
    clouds.
    """
    pairs = len(problem.source) * len(problem.target)
    only_paper = certificate or bound is not None
    if problem.model == "similarity2d" or only_paper or pairs > LARGE_PAIRS[3]:
        return "paper"
    return "full"


def default_sample(problem: Problem, bound: str | None, certificate: bool) -> int | None:
    """Points that are searched instead of all; None: all.

    Of large clouds some of the points give a better pose than all of them. Not so in space where all of
    them match: then norms tell enough.
    """
    n, m = len(problem.source), len(problem.target)
    free = bound is None and not certificate and problem.candidates is None
    by_norms = problem.dim == 3 and problem.n_inliers == n == m
    if not free or by_norms or n * m <= LARGE_PAIRS[problem.dim]:
        return None
    return LARGE_SAMPLE[problem.dim]
