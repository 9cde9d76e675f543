"""The table of modes. A mode rejects settings that it would ignore."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from dcreg.assignment.objective import is_large
from dcreg.driver.normalised import NormalisedProblem, Solution
from dcreg.families.registry import bound_parts, make_bound
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.sampled import search_sampled_rotation
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.names import AUTO, DEFAULT_BOUND, mode_names
from dcreg.problem import InputError, Problem, suggestion
from dcreg.search import Bound, Budget, Outcome, minimise
from dcreg.status import Status

# A dense cost matrix of more pairs than this does not fit into the memory of a common machine.
MAX_PAIRS = 100_000_000
# In norm space these match sorted norms and need no cost matrix.
MATRIX_FREE_BOUNDS = frozenset({"tight", "shared"})
# By dimension: point pairs above which a sample is searched, and the points of each cloud in it. In 2D,
# searches of some hundred points finish, but not even one local search of thousands of points does. In 3D
# a single assignment of mode `full` takes seconds.
LARGE_PAIRS = {2: 1_000_000, 3: 4_000_000}
LARGE_SAMPLE = {2: 300, 3: 1_000}
# Share of the time for the translation search; the rotation search follows.
TRANSLATION_SHARE = 0.8

# (problem, shifted source, budget) -> the best rotation about the origin
RotationSearch = Callable[[NormalisedProblem, np.ndarray, Budget], Outcome]


@dataclass(frozen=True)
class Mode:
    """A method to solve the problems of one model.

    Attributes
    ----------
    name, model : str
        Several models may share a name.
    summary : str
        One line for help texts and manuals.
    space : callable
        The space of the certified search, from a normalised problem.
    make_bound : callable, optional
        The mode's own bound, from ``(space, threads=...)``. None: the user chooses it by name.
    own_bound : str
        Name of the bound if the user does not choose one.
    rotation : callable, optional
        The rotation search that follows a search over translations.
    in_norm_space : bool
        Whether the bounds refer to norms, not to the residuals of a pose.
    certifies : str
        Family of the certificate that the search can record (``dcreg.certificate.format.MODELS``), or
        empty.
    stage : str
        Name of the certified search in events and stages.
    """

    name: str
    model: str
    summary: str
    space: Callable[[NormalisedProblem], Any]
    make_bound: Callable[..., Bound] | None = None
    own_bound: str = DEFAULT_BOUND
    rotation: RotationSearch | None = None
    in_norm_space: bool = False
    certifies: str = ""
    stage: str = "search"

    @property
    def search_share(self) -> float:
        """Share of the time for the certified search."""
        return 1.0 if self.rotation is None else TRANSLATION_SHARE

    def check(self, problem: Problem, bound: str | None, certificate: bool) -> None:
        """Reject settings that this mode would ignore, and clouds that do not fit into memory.

        Raises
        ------
        InputError
        """
        self.check_bound(bound)
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

    def check_bound(self, bound: str | None) -> None:
        """Refuse an unknown bound, and any bound if the mode has its own."""
        if bound is None:
            return
        bound_parts(bound)  # refuses unknown names
        if self.make_bound is not None:
            raise InputError(
                f"bound: mode {self.name!r} has its own bounds and does not accept {bound!r}; leave "
                "the bound out, or choose mode 'paper'"
            )

    def _is_matrix_free(self, problem: Problem, bound: str | None) -> bool:
        return (
            self.in_norm_space
            and self.make_bound is None
            and problem.candidates is None
            and MATRIX_FREE_BOUNDS.issuperset(bound_parts(bound or self.own_bound))
        )

    def bound(self, problem: NormalisedProblem, space: Any) -> Bound:
        """Return the bound of the certified search."""
        if self.make_bound is not None:
            return self.make_bound(space, threads=problem.threads)
        return make_bound(problem.bound, space, threads=problem.threads)

    def run(self, problem: NormalisedProblem) -> Solution:
        """Search the space of the mode, then recover the pose."""
        space = self.space(problem)
        bound = self.bound(problem, space)
        budget = problem.budget
        searching = budget if self.rotation is None else budget.sub_budget(self.search_share)
        found = minimise(
            space, bound, searching,
            tolerance=problem.tolerance, stage=self.stage, keep_leaves=problem.keep_leaves,
        )  # fmt: skip
        solution = Solution(
            np.empty(0), found.status, found.lower_bound, found.upper_bound, space.scope,
            certified=(bound.roots[0], found),
        )  # fmt: skip
        solution.add(self.stage, found)
        self.recover_pose(problem, space, found.theta, budget, solution)
        return solution

    def recover_pose(
        self,
        problem: NormalisedProblem,
        space: Any,
        theta: np.ndarray,
        budget: Budget,
        solution: Solution,
    ) -> None:
        """Complete the solution of a search that ended at `theta`, by a rotation search if needed."""
        if self.rotation is None:
            solution.T = space.pose(theta)
            solution.minima = [(space.pose(end), value) for end, value in space.ends]
            return
        found = self.rotation(problem, problem.source + theta, budget)
        solution.add("rotation", found)
        solution.T = shifted_rotation(Rotation3D.matrix(found.theta), theta)
        finished = (Status.OPTIMAL, Status.CONVERGED)
        if solution.status in finished and found.status is not Status.OPTIMAL:
            solution.status = found.status  # no stage proves more than the weakest one


def shifted_rotation(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return ``x -> rotation (x + shift)`` as a (4, 4) matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, rotation @ shift
    return T


def search_rotation(problem: NormalisedProblem, shifted: np.ndarray, budget: Budget) -> Outcome:
    """Find the best rotation of the shifted source; for large clouds from a sample."""
    large = is_large(len(problem.source), len(problem.target))
    if problem.candidates is None and large:
        return search_sampled_rotation(
            shifted, problem.target, problem.n_inliers,
            tolerance=problem.tolerance, budget=budget,
        )  # fmt: skip
    space = Rotation3D(shifted, problem.target, problem.n_inliers, problem.candidates, budget.stop)
    return minimise(
        space, RotationBound(space, threads=problem.threads), budget.named("start of rotation"),
        tolerance=problem.tolerance, stage="rotation",
    )  # fmt: skip


def _space(make: Callable[..., Any], more: Sequence[str], problem: NormalisedProblem) -> Any:
    """Return the space that `make` returns for a problem; `more` are fields that it needs, too."""
    names = "source", "target", "n_inliers", *more, "candidates", "budget.stop", "stationary_box"
    return make(*attrgetter(*names)(problem))


#: All modes. Several models may have a mode of the same name.
MODES = (
    Mode(
        "paper", "similarity2d", "searches the similarity as the paper does; certifies the pose",
        partial(_space, Similarity2D, ["scale_range"]), certifies="similarity2d",
    ),
    Mode(
        "full", "rigid3d", "searches translation and rotation together; certifies the rigid pose",
        partial(_space, Rigid3D.between, []), RigidBound, own_bound="rigid", stage="rigid",
    ),
    Mode(
        "paper", "rigid3d",
        "the paper's two stages: a translation in norm space, then a rotation for it",
        partial(_space, Translation3D, []), rotation=search_rotation, in_norm_space=True,
        certifies="translation3d",
    ),
)  # fmt: skip


def find_mode(model: str, name: str) -> Mode:
    """Return the mode called `name`.

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


def choose_mode(problem: Problem, bound: str | None = None, certificate: bool = False) -> str:
    """Return the mode that gives the best pose for the time.

    In 3D this is ``full``, which had the highest success rate over all shapes, disturbances, sizes and
    limits measured (``make modes``). It is ``paper`` if a certificate or a bound is requested, or if more
    than ``LARGE_PAIRS[3]`` point pairs are searched.
    """
    pairs = len(problem.source) * len(problem.target)
    only_paper = certificate or bound is not None
    if problem.model == "similarity2d" or only_paper or pairs > LARGE_PAIRS[3]:
        return "paper"
    return "full"
