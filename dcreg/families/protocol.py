"""The interface of a pose family: a space with local searches, and bounds over its boxes."""

from __future__ import annotations

import abc
import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np

from dcreg.assignment.descent import alternate
from dcreg.assignment.objective import k_assignment
from dcreg.families.kernels import Clouds
from dcreg.families.pairs import infeasibility_penalty, weighted_clouds
from dcreg.jit import NEVER
from dcreg.problem import PairWeights
from dcreg.search import Bound, Box, Boxes, Budget, Evaluation, Interrupted, Stored

Arrays = TypeVar("Arrays", bound=tuple[Any, ...])


class Space(abc.ABC):
    """A parameterised family of poses over a normalised problem.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
        Normalised points.
    n_inliers : int
    candidates : (n, m) bool array, optional
        The feasible pairs.
    stop_flag : (1,) uint8 array
        Set from another thread to stop kernels.
    stationary_box : bool
        Whether the start box is limited to the translations of stationary poses. Otherwise it follows
        from the radii of the clouds. Without effect on a space without translations.
    max_scale : float
        Maximum scale of a pose.

    Attributes
    ----------
    clouds : Clouds
        The problem as the kernels take it.
    axis_weights : (dim,) array
        RMS motion of the source per unit step along each axis.
    scope : str
        What a certificate over this space refers to.
    n_descents : int
        Local searches for the first incumbent: enough for a good upper bound, cheap next to the search.
    min_gain : float
        Relative decrease of the objective below which a local search ends.
    ends : sequence of (theta, value)
        Where the local searches of the last `start` ended.
    floor : float
        The minimum over all matchings of what pairs cost at every pose. 0 without weights and attributes.
    is_confirmed : bool
        Whether independent starts of the last `start` agreed on the best parameter.
    """

    axis_weights: np.ndarray
    scope: str
    n_descents: int
    min_gain: float
    ends: Sequence[tuple[np.ndarray, float]] = ()
    is_confirmed = False
    floor = 0.0

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        candidates: np.ndarray | None = None,
        stop_flag: np.ndarray = NEVER,
        stationary_box: bool = True,
        max_scale: float = 1.0,
    ) -> None:
        source, target = (np.asarray(points, dtype=np.float64) for points in (source, target))
        self.clouds = Clouds(
            np.ascontiguousarray(source.T),
            self.target_features(target),
            infeasibility_penalty(
                candidates, n_inliers, max_scale * radius(source) + radius(target)
            ),
            np.empty((0, 0)),
            np.ones(len(source)),
            n_inliers,
            stop_flag,
        )
        self.candidates, self.stationary_box = candidates, stationary_box

    def weighted(self, weights: PairWeights) -> Self:
        """Set the weights of pairs, and return the space."""
        self.clouds = clouds = weighted_clouds(self.clouds, weights)
        self.floor = k_assignment(clouds.weights * clouds.infeasibility_penalty, clouds.k)[0]
        return self

    def weights_of(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray | None:
        """Return the weights of pairs; None if all are 1."""
        weights = self.clouds.weights
        return weights[rows, columns] if weights.size else None

    @property
    def lightest(self) -> float:
        """The minimum weight of a pair; the maximum is 1."""
        return float(self.clouds.weights.min(initial=1.0))

    @staticmethod
    def target_features(target: np.ndarray) -> np.ndarray:
        """Return the features of the target; by default its (d, m) points."""
        return np.ascontiguousarray(target.T)

    @property
    def n_inliers(self) -> int:
        return self.clouds.k

    @property
    def stop_flag(self) -> np.ndarray:
        """(1,) uint8 array: kernels return at once when it is set, and `check` then raises."""
        return self.clouds.stop

    def with_stop_flag(self, stop_flag: np.ndarray) -> Self:
        """Return the same space with another stop flag."""
        other = copy.copy(self)
        other.clouds = self.clouds._replace(stop=stop_flag)
        return other

    def check(self) -> None:
        """Raise after a kernel if the flag is set: the kernel's output is then incomplete.

        Raises
        ------
        Interrupted
        """
        if self.stop_flag[0]:
            raise Interrupted

    @abc.abstractmethod
    def roots(self) -> list[Box]:
        """Return boxes that together contain every global minimiser."""

    @abc.abstractmethod
    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Return E(theta) and the column matched to every source row (-1: none)."""

    @abc.abstractmethod
    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        """Return the best parameter for a matching, from the parameter `theta`."""

    def normalised(self, theta: np.ndarray) -> np.ndarray:
        """Return the parameter of the same pose that lies in a root."""
        return theta

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and fit from `theta`.

        Returns
        -------
        theta, value, n_assignments
            Of an admissible parameter.
        """
        value, col_of = self.objective(theta)
        theta, value, _, spent = alternate(
            theta, value, col_of, self.fit_matching, self.objective, self.min_gain
        )
        return self.normalised(theta), value, spent + 1

    def worth_refining(self, value: float) -> float:
        """Return the objective up to which a local search from a box pays; `value` is known."""
        return np.inf

    @abc.abstractmethod
    def pose(self, theta: np.ndarray) -> np.ndarray:
        """Return the pose of the source as a (d+1, d+1) matrix."""

    @abc.abstractmethod
    def seeds(self) -> np.ndarray:
        """Return (S, dim) parameters spread over the family, from which local searches start."""

    @abc.abstractmethod
    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """Return a score per seed (lower is better), and the number of assignments solved for it."""

    @property
    def n_pairs(self) -> int:
        """Number of pairs whose costs one evaluation of the objective needs."""
        return self.n_source * self.n_target

    @property
    def n_source(self) -> int:
        return int(self.clouds.source.shape[1])

    @property
    def n_target(self) -> int:
        return int(self.clouds.target.shape[-1])

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        """Tell which of (B, dim) parameters are poses of the family."""
        return np.ones(len(thetas), dtype=bool)

    def touches(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Tell which of B boxes may contain an admissible parameter; False is certain."""
        return np.ones(len(lower), dtype=bool)

    def starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield initial parameters, best first, each with the assignments solved for it."""
        self.check()
        seeds = self.seeds()
        scores, spent = self.score(seeds)
        self.check()
        for seed in seeds[np.argsort(scores, kind="stable")[: self.n_descents]]:
            yield seed, spent
            spent = 0

    def start(
        self, budget: Budget, enough: float = 0.0, known: float = np.inf
    ) -> tuple[np.ndarray, float, int]:
        """Return the best result of the local searches from `starts`.

        At least one local search is begun, even if the time is over or all assignments are spent. After
        `n_descents` local searches, a value of at most `enough` ends the list of starts. Only values
        below `known` are reported.

        Returns
        -------
        theta, value, n_assignments
            The value is infinite if no local search was completed.
        """
        best: np.ndarray | None = None
        value, spent = np.inf, 0
        ends = self.ends = []
        try:
            for tried, (theta, choosing) in enumerate(self.starts(budget), start=1):
                spent += choosing
                if best is not None and (budget.is_over or budget.spent(0, spent, 0.0)):
                    break
                best = theta if best is None else best
                theta, found, descending = self.refine(theta)
                spent += descending
                ends.append((theta, found))
                if found < value:
                    best, value = theta, found
                    if value < known:
                        budget.report_incumbent(value)
                if tried >= self.n_descents and value <= enough:  # before the next start is made
                    break
        except Interrupted:
            pass
        return self.seeds()[0] if best is None else best, value, spent


def rows_of(arrays: Arrays, part: slice) -> Arrays:
    """Return some rows of every array of a named tuple, which may hold further ones."""
    rows = (rows_of(a, part) if isinstance(a, tuple) else a[part] for a in arrays)
    return type(arrays)(*rows)


def radius(points: np.ndarray) -> float:
    """Return the maximum distance of a point from the origin."""
    return float(np.sqrt((points**2).sum(axis=1)).max())


S = TypeVar("S", bound=Space)


class SpaceBound(abc.ABC, Generic[S]):
    """A bounding function over the boxes that bisection makes of some roots.

    A bound is found by its `name` if its module is called ``bound*`` and lies in the folder of a family;
    see `dcreg.families.registry`. Subclasses bound boxes in `_evaluate`. This class assigns +inf to
    boxes without an admissible parameter and to inadmissible candidates, and evaluates slices of boxes
    in parallel threads. Slices are independent, so the result is the same for any number of threads.

    Parameters
    ----------
    space : Space
    roots : sequence of Box, optional
        Default: those of the space.
    threads : int

    Attributes
    ----------
    name : str
        The name in ``--bound``; empty for a base class.
    space_type : type of Space
        Spaces that it bounds.
    n_assignments : int
        Exact assignments solved so far.
    stored : Stored, optional
        What the bound remembers about boxes.
    round_pairs, max_round : int
        Maximum in one round: enough to keep threads busy, few enough to stay interruptible.
    slice_pairs : int
        Minimum number of pairs in a thread's share: less is bounded sooner than handed over.
    """

    name: ClassVar[str] = ""
    space_type: ClassVar[type[Space]]
    round_pairs, max_round, slice_pairs = 8_000_000, 256, 32_768
    stored: Stored | None = None

    def __init__(self, space: S, roots: Sequence[Box] | None = None, threads: int = 1) -> None:
        self.space = space
        self.roots = list(roots) if roots is not None else space.roots()
        self.n_assignments = 0
        self._n_helpers = threads - 1
        self._helpers = ThreadPoolExecutor(self._n_helpers) if threads > 1 else None

    @property
    def round_size(self) -> int:
        return int(np.clip(self.round_pairs // self.space.n_pairs, 1, self.max_round))

    def fresh(self) -> Self:
        """Return the same bound without what it has stored about the boxes so far."""
        return type(self)(self.space, self.roots, self._n_helpers + 1)

    @abc.abstractmethod
    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation: ...

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        """Bound B boxes; see `dcreg.search.Bound`."""
        touched = np.flatnonzero(self.space.touches(boxes.lower, boxes.upper))
        found = self._evaluate(boxes[touched], cutoff)
        if self.space.floor > 0.0:  # the bounds of large boxes can be lower
            np.maximum(found.lower_bounds, self.space.floor, out=found.lower_bounds)
        found.values[~self.space.admissible(found.thetas)] = np.inf
        if len(touched) == len(boxes):
            return found
        count, warm_start = len(boxes), found.warm_start
        every = Evaluation(np.full(count, np.inf), boxes.centres, np.full(count, np.inf))
        every.lower_bounds[touched], every.thetas[touched] = found.lower_bounds, found.thetas
        every.values[touched] = found.values
        if warm_start is not None:
            every.warm_start = np.zeros((count, *warm_start.shape[1:]), warm_start.dtype)
            every.warm_start[touched] = warm_start
        return every

    def map_slices(self, count: int, work: Callable[[slice], int]) -> None:
        """Apply `work` to slices that cover `count` items, in all threads.

        There are several times as many slices as threads, or fewer if they would be too small. Each
        thread takes the next one when it is free. The results of `work` are added to `n_assignments`.
        """
        self.space.check()
        large_enough = count * self.space.n_pairs // self.slice_pairs
        parts = min(count, large_enough, 8 * (self._n_helpers + 1))
        if self._helpers is None or parts < 2:
            self.n_assignments += work(slice(0, count)) if count else 0
        else:
            edges = np.linspace(0, count, parts + 1).astype(int).tolist()
            # taking the next slice is one step of the interpreter: no two threads get the same
            slices = iter([slice(*each) for each in itertools.pairwise(edges)])

            def take() -> int:
                return sum(map(work, slices))

            helpers = [self._helpers.submit(take) for _ in range(min(self._n_helpers, parts - 1))]
            done = take()
            self.n_assignments += done + sum(helper.result() for helper in helpers)
        self.space.check()


class Strongest:
    """The maximum of several bounds over the same roots, box by box, with the best candidate of all."""

    def __init__(self, parts: Sequence[SpaceBound[Any]]) -> None:
        self.parts = parts

    @property
    def roots(self) -> list[Box]:
        return self.parts[0].roots

    @property
    def round_size(self) -> int:
        return min(part.round_size for part in self.parts)

    @property
    def n_assignments(self) -> int:
        return sum(part.n_assignments for part in self.parts)

    def fresh(self) -> Strongest:
        return Strongest([part.fresh() for part in self.parts])

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        """Bound B boxes; see `dcreg.search.Bound`. There is no warm start: parts would need one each."""
        best = self.parts[0].evaluate(boxes, cutoff)
        for part in self.parts[1:]:
            other = part.evaluate(boxes, cutoff)
            best.lower_bounds = np.maximum(best.lower_bounds, other.lower_bounds)
            better = other.values < best.values
            best.thetas[better], best.values[better] = other.thetas[better], other.values[better]
        best.warm_start = None
        return best


# (space, roots, threads) -> bound
MakeBound = Callable[..., Bound]
