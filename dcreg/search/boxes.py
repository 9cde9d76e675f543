"""Boxes of parameters, the interface of a bound over them, the queue of open boxes, and leaf boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from dcreg.search import kernels


@dataclass(frozen=True)
class Box:
    """``lower <= theta <= upper``, componentwise; an axis may have zero width."""

    lower: np.ndarray
    upper: np.ndarray

    def __post_init__(self) -> None:
        if self.lower.shape != self.upper.shape or not (self.lower <= self.upper).all():
            raise ValueError(f"not a box: lower {self.lower}, upper {self.upper}")

    @property
    def dim(self) -> int:
        return self.lower.size

    @property
    def centre(self) -> np.ndarray:
        return 0.5 * (self.lower + self.upper)

    @property
    def half_widths(self) -> np.ndarray:
        return 0.5 * (self.upper - self.lower)

    def vertices(self) -> np.ndarray:
        """Return the (2**d, d) vertices, repeated if an axis has zero width."""
        choices = np.stack([self.lower, self.upper])
        bits = (np.arange(2**self.dim)[:, None] >> np.arange(self.dim)) & 1
        return choices[bits, np.arange(self.dim)]

    def sample(self, generator: np.random.Generator, size: int) -> np.ndarray:
        return generator.uniform(self.lower, self.upper, (size, self.dim))


class Boxes:
    """B boxes, with lower bounds and warm starts.

    Attributes
    ----------
    lower, upper : (B, d) arrays
    bounds : (B,) array
        Lower bounds on the objective; zeros by default.
    warm_start : (B, h) array, optional
        `Evaluation.warm_start` of the boxes or of their parents.
    """

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        bounds: np.ndarray | None = None,
        warm_start: np.ndarray | None = None,
    ) -> None:
        self.lower, self.upper, self.warm_start = lower, upper, warm_start
        self.bounds = np.zeros(len(lower)) if bounds is None else bounds

    @classmethod
    def of(cls, boxes: Sequence[Box]) -> Boxes:
        """Return single boxes as one object."""
        return cls(np.array([box.lower for box in boxes]), np.array([box.upper for box in boxes]))

    @classmethod
    def joined(cls, *parts: Boxes) -> Boxes:
        """Return all; they have warm starts only if all parts do."""
        warm_starts = [part.warm_start for part in parts if part.warm_start is not None]
        return cls(
            np.concatenate([part.lower for part in parts]),
            np.concatenate([part.upper for part in parts]),
            np.concatenate([part.bounds for part in parts]),
            np.concatenate(warm_starts) if len(warm_starts) == len(parts) else None,
        )

    def __len__(self) -> int:
        return len(self.lower)

    def __getitem__(self, chosen: slice | np.ndarray) -> Boxes:
        """Return some of the boxes."""
        warm_start = None if self.warm_start is None else self.warm_start[chosen]
        return Boxes(self.lower[chosen], self.upper[chosen], self.bounds[chosen], warm_start)

    @property
    def centres(self) -> np.ndarray:
        return 0.5 * (self.lower + self.upper)

    def repeated(self, count: int) -> Boxes:
        """Return each box `count` times, one copy after the other."""
        return self[np.repeat(np.arange(len(self)), count)]


class LongestEdge:
    """Bisect the longest edge, where axes are weighted by how far a unit step moves the source.

    The weights make axes comparable: a unit step of a rotation parameter moves the source by about its
    RMS radius, a unit step of a translation by one.
    """

    def __init__(self, weights: np.ndarray) -> None:
        self.weights = np.asarray(weights, dtype=np.float64)

    def __call__(self, boxes: Boxes) -> Boxes:
        """Return the 2 B children of B boxes; the halves of a box are adjacent."""
        axis = np.argmax((boxes.upper - boxes.lower) * self.weights, axis=1)
        rows, halves = np.arange(len(boxes)), boxes.repeated(2)
        halves.upper[2 * rows, axis] = halves.lower[2 * rows + 1, axis] = boxes.centres[rows, axis]
        return halves


@dataclass
class Evaluation:
    """Bounds of B boxes, and a candidate parameter in each.

    Attributes
    ----------
    lower_bounds : (B,) array
        Valid for every admissible theta of the box, or at least for every global optimum in it, which
        suffices for a search; +inf if the box contains no admissible theta.
    thetas : (B, d) array
        One candidate per box, admissible or not.
    values : (B,) array
        Upper bounds on the objective at `thetas`; +inf if theta is not admissible.
    warm_start : (B, h) array, optional
        Data from which the bounds of the children of these boxes start. The validity of a bound does not
        depend on it.
    """

    lower_bounds: np.ndarray
    thetas: np.ndarray
    values: np.ndarray
    warm_start: np.ndarray | None = None

    @classmethod
    def empty(cls, boxes: Boxes) -> Evaluation:
        """Return an evaluation to be filled, with the centres of the boxes as candidates."""
        return cls(np.empty(len(boxes)), boxes.centres, np.empty(len(boxes)))


class Stored(Protocol):
    """What a bound remembers about boxes, such as values at their vertices."""

    def state(self) -> dict[str, Any]:
        """Return arrays and numbers from which `restore` makes an equal object."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Replace the content by a saved state."""
        ...


class Bound(Protocol):
    """A lower bounding function for the `roots` and for all boxes that bisection makes of them."""

    @property
    def roots(self) -> list[Box]:
        """Boxes that together cover the search region."""
        ...

    @property
    def round_size(self) -> int:
        """Maximum number of boxes divided between two readings of the clock."""
        ...

    @property
    def n_assignments(self) -> int:
        """Number of exact assignments solved so far."""
        ...

    def fresh(self) -> Bound:
        """Return the same bound without the data that it has stored about boxes so far."""
        ...

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        """Bound B boxes, which may have the warm starts of their parents.

        The evaluation of a box may stop early: when its bound reaches the cutoff, or when the cutoff is
        out of reach, because the box is then divided in any case. If `cutoff` is None, it never does.
        """
        ...


@dataclass(frozen=True)
class Confined:
    """Boxes to which a stage confines a search, and a bound on all optima outside them.

    Attributes
    ----------
    boxes : Boxes
    outside : float
        Lower bound on the objective of every optimum outside the boxes; inf if there is none.
    time_s : float
        Seconds that the stage took.
    n_tried : int
        Units of work that the stage took. Each cover has its own unit, such as a box tested.
    stage : str
        Name of the stage.
    """

    boxes: Boxes
    outside: float
    time_s: float = 0.0
    n_tried: int = 0
    stage: str = ""

    def meeting(self, boxes: Boxes) -> Boxes:
        """Return those of `boxes` that overlap a confined box."""
        meets = np.zeros(len(boxes), np.bool_)
        kernels.meeting(boxes.lower, boxes.upper, *self._hierarchy, meets)
        return boxes if meets.all() else boxes[meets]

    @cached_property
    def _hierarchy(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the hierarchy of the boxes that `kernels.meeting` needs."""
        order = morton_order(self.boxes.lower)
        levels = [(self.boxes.lower[order], self.boxes.upper[order])]
        while len(levels[-1][0]) > kernels.FAN:
            lower, upper = levels[-1]
            firsts = np.arange(0, len(lower), kernels.FAN)
            levels.append((np.minimum.reduceat(lower, firsts), np.maximum.reduceat(upper, firsts)))
        starts = np.cumsum([0, *(len(lower) for lower, _ in levels)])
        lower, upper = (np.concatenate(ends) for ends in zip(*levels, strict=True))
        return lower, upper, starts


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the order of (n, d) points along a curve that keeps near points together."""
    dim = points.shape[1]
    n_bits = min(62 // dim, 20)
    low = points.min(axis=0, initial=np.inf)
    extent = np.maximum(points.max(axis=0, initial=-np.inf) - low, 1e-300)
    cells = ((points - low) / extent * (2**n_bits - 1)).astype(np.int64)
    keys = np.zeros(len(points), np.int64)
    for bit, axis in np.ndindex(n_bits, dim):
        keys |= ((cells[:, axis] >> bit) & 1) << (bit * dim + axis)
    return np.argsort(keys, kind="stable")


class OpenNodes:
    """Priority queue of open boxes: lowest bound first, then the larger box, then the older one."""

    def __init__(self, dim: int, capacity: int = 64) -> None:
        self._lower, self._upper = np.empty((capacity, dim)), np.empty((capacity, dim))
        self._warm_starts = np.empty((capacity, 0), np.uint16)
        self._bounds, self._sizes = np.empty(capacity), np.empty(capacity)
        self._serials = np.empty(capacity, np.int64)
        self._heap = np.empty(capacity, np.int64)
        self._free = np.arange(capacity)  # slots; the first _length of them are taken
        self._length = 0
        self._serial = 0

    def __len__(self) -> int:
        return self._length

    @property
    def nbytes(self) -> int:
        """Memory of the open boxes, in bytes."""
        extra = self._warm_starts.itemsize * self._warm_starts.shape[1]
        return self._length * (16 * self._lower.shape[1] + 40 + extra)

    @property
    def lower_bound(self) -> float:
        return float(self._bounds[self._heap[0]]) if self._length else np.inf

    def push(self, boxes: Boxes) -> None:
        """Add boxes. Either all boxes of a search have warm starts, or none has."""
        count, warm_start = len(boxes), boxes.warm_start
        if warm_start is not None and not self._length:
            self._warm_starts = np.empty((len(self._heap), warm_start.shape[1]), warm_start.dtype)
        while self._length + count > len(self._heap):
            self._double()
        slots = self._free[self._length : self._length + count]
        self._lower[slots], self._upper[slots] = boxes.lower, boxes.upper
        self._bounds[slots] = boxes.bounds
        if warm_start is not None:
            self._warm_starts[slots] = warm_start
        self._sizes[slots] = (boxes.upper - boxes.lower).sum(axis=1)
        self._serials[slots] = np.arange(self._serial, self._serial + count)
        self._serial += count
        self._length = kernels.push(
            self._heap, self._length, slots, self._bounds, self._sizes, self._serials
        )

    def pop(self, count: int, cutoff: float) -> Boxes:
        """Remove and return the best boxes with bounds below `cutoff`, at most `count`."""
        slots = np.empty(count, np.int64)
        taken = kernels.pop(
            self._heap, self._length, cutoff, self._bounds, self._sizes, self._serials, slots
        )
        slots = slots[:taken]
        self._length -= taken
        self._free[self._length : self._length + taken] = slots
        return self._at(slots)

    def boxes(self) -> Boxes:
        """Return all boxes, the oldest first; a queue to which they are pushed returns the same ones."""
        slots = self._heap[: self._length]
        return self._at(slots[np.argsort(self._serials[slots])])

    def _at(self, slots: np.ndarray) -> Boxes:
        warm_start = self._warm_starts[slots] if self._warm_starts.shape[1] else None
        return Boxes(self._lower[slots], self._upper[slots], self._bounds[slots], warm_start)

    def _double(self) -> None:
        capacity = len(self._heap)
        boxes = ("_lower", "_upper", "_warm_starts", "_bounds", "_sizes", "_serials")
        for name in (*boxes, "_heap", "_free"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.empty_like(old)]))
        self._free[capacity:] = np.arange(capacity, 2 * capacity)


class Leaves:
    """The leaf boxes of a search: the boxes that it did not divide, a partition of the roots.

    An infinite bound means that the box contains no admissible parameter. Other boxes were pruned,
    with a bound within the tolerance of the upper bound, unless ``is_open``: then a limit ended the
    search first.
    """

    def __init__(self) -> None:
        self._parts: list[Boxes] = []
        self._is_open: list[np.ndarray] = []

    def add(self, boxes: Boxes, is_open: bool = False) -> None:
        self._parts.append(boxes)
        self._is_open.append(np.full(len(boxes), is_open))

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    @property
    def boxes(self) -> Boxes:
        """All leaves, with their warm starts if all have them."""
        return Boxes.joined(*self._parts)

    @property
    def is_open(self) -> np.ndarray:
        """Whether a limit ended the search before a leaf was pruned: (L,)."""
        return np.concatenate(self._is_open)
