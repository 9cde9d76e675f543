"""Mode `multi`: the paper's two stages over several translations; the best rigid objective wins.

First the best of descents from a grid of poses, as in mode `full`. Then the translation in norm space,
certified to the tolerance, and every box of translations whose norm objective may lie within a margin of
its optimum, each giving a descent. The distinct ends, and the translation that joins the centroids, go
through a rotation search, as far as it may still better the best pose, and a joint refinement of
matching and pose. The certificate is that of the norm objective alone: it says nothing of the rotation,
nor that the best pose is the best of all.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dcreg.driver.paper import pose_of
from dcreg.driver.task import Answer, Task
from dcreg.families.registry import make_bound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.translation3d.space import Translation3D
from dcreg.result import Stage
from dcreg.search import Bound, Box, Budget, Event, Interrupted, LongestEdge, Outcome, minimise
from dcreg.status import Status

SCOPE = "translation in norm space, best of its basins"
MAX_DESCENTS = 100  # in norm space, from boxes that may hold a low place
# Gap of a basin's rotation as a share of its value; wide, because a joint descent follows.
BASIN_GAP = 0.5
TRANSLATION_SHARE = 0.25  # of the time, for the norm objective: its bounds do not find the pose
_BATCH = 16  # boxes bounded together while low places are sought


@dataclass(frozen=True)
class Settings:
    """How many translations are followed.

    Attributes
    ----------
    margin : float, optional
        Translations with a norm objective this far above the best count; default: the tolerance.
    separation : float
        Translations closer than this are one basin, in units of the points.
    max_basins : int
        Rotation searches made at most.
    basin_nodes : int
        Boxes spent on finding the basins.
    """

    margin: float | None = None
    separation: float = 0.1
    max_basins: int = 12
    basin_nodes: int = 20_000


@dataclass(frozen=True)
class Basin:
    """A distinct low place of the norm objective, and what the rotation search made of it.

    Attributes
    ----------
    translation : (3,) array
        t of x + t: a local minimiser, or that of the best pose of a grid.
    norm_value : float
        The norm objective there.
    T : (4, 4) array
        The refined pose from this translation.
    value : float
        The rigid objective at `T`.
    """

    translation: np.ndarray
    norm_value: float
    T: np.ndarray
    value: float


@dataclass
class MultiAnswer(Answer):
    """`Answer` whose bounds are those of the norm objective.

    Attributes
    ----------
    value : float
        The rigid objective at `T`.
    basins : list of Basin
        Best rigid objective first.
    complete : bool
        Whether every translation within the margin was looked at; if not, only the lowest found.
    """

    value: float = np.inf
    basins: list[Basin] = field(default_factory=list)
    complete: bool = False


def run(task: Task, settings: Settings = Settings()) -> MultiAnswer:
    """The best rigid pose over the basins of the norm objective."""
    norms = Translation3D(
        task.source, task.target, task.n_inliers, task.reduced_box, task.candidates,
        task.budget.stop,
    )  # fmt: skip
    rigid = Rigid3D.between(
        task.source, task.target, task.n_inliers, candidates=task.candidates,
        stop_flag=task.budget.stop,
    )  # fmt: skip
    first, first_stage = _first_basin(norms, rigid, task.budget)
    descents = _Descents(norms)
    bound = make_bound(task.bound, norms, threads=task.threads)
    theta, value, spent = descents.first()
    found = minimise(
        norms, bound, task.budget.sub_budget(TRANSLATION_SHARE), gap_tol=task.gap_tol, start=(theta, value),
        refine=descents.refine,
    )  # fmt: skip
    found.n_assignments += spent
    answer = MultiAnswer(
        first.T, found.status, found.lower_bound, found.upper_bound, SCOPE,
        stages=[first_stage], basins=[first],
    )  # fmt: skip
    answer.add("search", found)
    answer.ends = rigid.poses_of_ends()
    try:
        in_time = _follow(task, settings, norms, rigid, bound, descents, found, answer)
    except Interrupted:
        in_time = answer.complete = False
    if not in_time and answer.status is Status.OPTIMAL:
        answer.status = task.budget.ended_by
    answer.basins.sort(key=lambda basin: basin.value)
    answer.T, answer.value = answer.basins[0].T, answer.basins[0].value
    return answer


def _follow(
    task: Task,
    settings: Settings,
    norms: Translation3D,
    rigid: Rigid3D,
    bound: Bound,
    descents: _Descents,
    found: Outcome,
    answer: MultiAnswer,
) -> bool:
    """A rotation search for every low place of the norm objective; whether there was time for all."""
    looking = task.budget.sub_budget(0.5)
    translations = _low_places(task, settings, bound, descents, found, answer, looking)
    in_time = not looking.is_over
    for done, translation in enumerate(translations):
        if task.budget.is_over:
            answer.complete = False
            return False
        budget = task.budget.sub_budget(1.0 / (len(translations) - done))
        name = f"basin {done + 1} of {len(translations)}"
        _try_basin(task, settings, norms, rigid, translation, budget, answer, name)
    return in_time


def _first_basin(norms: Translation3D, rigid: Rigid3D, budget: Budget) -> tuple[Basin, Stage]:
    """The best of descents from a grid of poses: where every search for the pose may start."""
    began = budget.elapsed()
    theta, value, spent = rigid.start(budget.sub_budget(0.25))
    T = rigid.pose(theta)
    translation = T[:3, :3].T @ T[:3, 3]
    try:
        norm_value = norms.objective(translation)[0]
    except Interrupted:
        norm_value = np.inf
    basin = Basin(translation, norm_value, T, value)
    return basin, Stage("start", time_s=budget.elapsed() - began, n_assignments=spent)


def _low_places(
    task: Task,
    settings: Settings,
    bound: Bound,
    descents: _Descents,
    found: Outcome,
    answer: MultiAnswer,
    budget: Budget,
) -> list[np.ndarray]:
    """Distinct translations with a low norm objective, and the one that joins the centroids."""
    began = task.budget.elapsed()
    spent = bound.n_assignments + descents.spent
    margin = task.turning_tol if settings.margin is None else settings.margin
    cutoff = found.upper_bound + margin
    node_limit = settings.basin_nodes
    if budget.nodes is not None:
        node_limit = min(node_limit, budget.nodes)
    centres, n_nodes, complete = _low_boxes(
        bound, bound.roots[0], cutoff, settings.separation, node_limit, budget
    )
    for theta in centres[:: max(1, -(-len(centres) // MAX_DESCENTS))]:
        if budget.is_over:
            complete = False
            break
        descents.refine(theta)
    lowest = descents.distinct(cutoff, settings.separation, settings.max_basins)
    answer.complete = (
        complete and len(lowest) < settings.max_basins and len(centres) <= MAX_DESCENTS
    )
    now = task.budget.elapsed()
    spent = bound.n_assignments + descents.spent - spent
    answer.stages.append(Stage("basins", now - began, n_nodes, spent))
    task.budget.tell(
        Event("end", "basins", now, n_nodes, spent, 0, found.lower_bound, found.upper_bound)
    )
    return [*lowest, task.target.mean(axis=0) - task.source.mean(axis=0)]


def _low_boxes(
    bound: Bound, root: Box, cutoff: float, width: float, node_limit: int, budget: Budget
) -> tuple[np.ndarray, int, bool]:
    """Centres of boxes at most `width` wide that together hold every theta below `cutoff`; work.

    Last is False where a limit ended the division early: then boxes are missing.
    """
    branching = LongestEdge(np.ones(root.dim))
    stack = [(root.lower[None], root.upper[None])]
    leaves: list[np.ndarray] = [np.empty((0, root.dim))]
    n_nodes = 0
    while stack:
        held = sum(part[0].nbytes + part[1].nbytes for part in stack)
        full = budget.memory_mb is not None and held > budget.memory_mb * 2**20
        if n_nodes >= node_limit or full or budget.is_over:
            return np.concatenate(leaves), n_nodes, False
        lower, upper = stack.pop()
        found = bound.evaluate(lower, upper, cutoff)
        n_nodes += len(lower)
        low = found.lower_bounds < cutoff
        fine = low & ((upper - lower).max(axis=1) <= width)
        leaves.append(0.5 * (lower + upper)[fine])
        lower, upper = lower[low & ~fine], upper[low & ~fine]
        stack += [
            branching(lower[at : at + _BATCH], upper[at : at + _BATCH])
            for at in range(0, len(lower), _BATCH)
        ]
    return np.concatenate(leaves), n_nodes, True


def _try_basin(
    task: Task,
    settings: Settings,
    norms: Translation3D,
    rigid: Rigid3D,
    translation: np.ndarray,
    budget: Budget,
    answer: MultiAnswer,
    name: str,
) -> None:
    """The rotation search about one translation, where it may better the best pose."""
    best = min(basin.value for basin in answer.basins)
    norm_value = norms.objective(translation)[0]
    # a pose within half a `separation` of this translation and better than the best has, at this
    # very translation, an objective below `worth`
    worth = (np.sqrt(best) + 0.5 * settings.separation * np.sqrt(task.n_inliers)) ** 2
    if norm_value >= worth:
        return
    space = Rotation3D(
        task.source + translation, task.target, task.n_inliers, task.candidates, budget.stop
    )
    theta, value, spent = space.start(budget.named(f"start of {name}"))
    value = min(value, worth)
    turned = minimise(
        space, RotationBound(space, threads=task.threads), budget,
        gap_tol=max(task.turning_tol, BASIN_GAP * value), start=(theta, value), stage=name,
    )  # fmt: skip
    T = pose_of(Rotation3D.matrix(turned.theta), translation)
    theta, value, refining = rigid.refine(rigid.theta(T))
    if value < best:
        task.budget.named("best pose").report_incumbent(value)
    answer.basins.append(Basin(translation, norm_value, rigid.pose(theta), value))
    turned.n_assignments += spent + refining
    answer.add(name, turned)
    if answer.status is Status.OPTIMAL or turned.status is Status.STOPPED:
        answer.status = turned.status


class _Descents:
    """Descents in norm space, each end remembered."""

    def __init__(self, space: Translation3D) -> None:
        self.space = space
        self.ends: list[tuple[float, np.ndarray]] = []
        self.spent = 0

    def first(self) -> tuple[np.ndarray, float, int]:
        """The descent from the identity; the identity itself where no time is left for it."""
        try:
            return self.refine(self.space.identity)
        except Interrupted:
            return self.space.identity, np.inf, 0

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        theta, value, spent = self.space.refine(theta)
        self.ends.append((value, theta))
        self.spent += spent
        return theta, value, spent

    def distinct(self, cutoff: float, separation: float, count: int) -> list[np.ndarray]:
        """Up to `count` ends at or below `cutoff`, lowest first, `separation` apart."""
        kept: list[np.ndarray] = []
        for value, theta in sorted(self.ends, key=lambda end: end[0]):
            if value > cutoff or len(kept) == count:
                break
            if all(np.linalg.norm(theta - other) > separation for other in kept):
                kept.append(theta)
        return kept
