"""What a metric is given, and how it is registered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from data.sampling import reference_pose
from dcreg.problem import apply_pose
from workflows import UserError


@dataclass(frozen=True)
class Case:
    """A pose to evaluate, with everything that its metrics need."""

    T: np.ndarray
    T_true: np.ndarray
    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray
    n_inliers: int
    scale_range: tuple[float, float]
    # Limits of the errors of a successful pose, by metric (`data.contract.Card.success_limits`).
    success_limits: Mapping[str, float] = field(default_factory=dict)
    lower_bound: float = np.nan
    marks: np.ndarray | None = None  # (k, 2 d): see `workflows.instances.Truth`
    scope: str = ""  # what the lower bound refers to
    is_downsampled: bool = False  # the method received fewer points: its objective is another one
    truth_in_cube: float = np.nan  # 1 or 0; of methods that search a cube of translations
    shape_length: float | None = None  # longest side of the shape at the reference scale, if known

    @property
    def dim(self) -> int:
        return self.source.shape[1]

    @cached_property
    def inliers(self) -> tuple[np.ndarray, np.ndarray]:
        """Source and target points of the true pairs, row by row."""
        if self.marks is not None:
            return self.marks[:, : self.dim], self.marks[:, self.dim :]
        return self.source[self.pairs[:, 0]], self.target[self.pairs[:, 1]]

    @cached_property
    def residuals(self) -> np.ndarray:
        """Distances of the true pairs at the evaluated pose."""
        source, target = self.inliers
        return np.linalg.norm(apply_pose(self.T, source) - target, axis=1)

    @cached_property
    def rmse(self) -> float:
        """RMS distance of the true pairs at the evaluated pose."""
        return self.rms_at(self.T)

    @cached_property
    def longest_side(self) -> float:
        """Longest side of the shape or, if unknown, of the bounding box of the target's true inliers."""
        if self.shape_length is not None:
            return self.shape_length
        return float(np.ptp(self.inliers[1], axis=0).max())

    @cached_property
    def rmse_floor(self) -> float:
        """RMS distance of the true pairs at the admissible pose fitted to them."""
        source, target = self.inliers
        if len(source) < self.dim:
            return float("nan")
        rows = np.column_stack([np.arange(len(source))] * 2)
        return self.rms_at(reference_pose(source, target, rows, self.scale_range))

    @cached_property
    def rmse_excess(self) -> float:
        """Error above the floor; 0 for a pose below it, which lies outside the scale range."""
        return float(np.sqrt(max(0.0, self.rmse**2 - self.rmse_floor**2)))

    @cached_property
    def objective(self) -> float:
        return self._objective_at(self.T)

    @cached_property
    def objective_true(self) -> float:
        return self._objective_at(self.T_true)

    def rms_at(self, T: np.ndarray) -> float:
        """RMS distance of the true pairs at a pose."""
        source, target = self.inliers
        residuals = apply_pose(T, source) - target
        return float(np.sqrt((residuals**2).sum(axis=1).mean()))

    def _objective_at(self, T: np.ndarray) -> float:
        import dcreg
        from dcreg.assignment.objective import is_large

        if self.is_downsampled or is_large(len(self.source), len(self.target)):
            return float("nan")  # takes seconds for large clouds, in every run
        value, _ = dcreg.objective(self.source, self.target, T, self.n_inliers)
        return float(value)


Compute = Callable[[Case], float]


class MetricError(UserError):
    """A metric cannot be registered; the message names it and both places."""


class Metric(NamedTuple):
    """A column of the table of runs."""

    unit: str
    better: Literal["lower", "higher", "none"]
    worst: float  # the value of runs without a pose wherever runs are ranked or summarised
    meaning: str
    compute: Compute | None  # None: filled in by `workflows.stages.evaluate.relate`
    axis: str = ""  # title of its axis in the figures of error against level; empty: not drawn
    recorded: bool = False  # part of the small table that is kept with a version
    module: str = ""  # that defines it

    @property
    def is_added(self) -> bool:
        """Whether another package adds it, so that earlier tables do not have it."""
        return not self.module.startswith(f"{__package__}.")


METRICS: dict[str, Metric] = {}


def metric(
    unit: str,
    better: Literal["lower", "higher", "none"],
    worst: float = np.nan,
    *,
    axis: str = "",
    recorded: bool = False,
    relative: bool = False,
) -> Callable[[Compute], Compute]:
    """Register a function of a `Case` as a metric; its docstring is the meaning of the column.

    A `relative` metric compares the runs of an instance; `workflows.stages.evaluate.relate` fills it in.
    """

    def register(function: Compute) -> Compute:
        meaning = " ".join((function.__doc__ or "").split()).removesuffix(".")
        compute = None if relative else function
        name, module = function.__name__, function.__module__
        if name in METRICS and METRICS[name].module != module:
            raise MetricError(
                f"metric {name!r} is defined twice: by {METRICS[name].module} and by {module}; rename "
                "one of them"
            )
        METRICS[name] = Metric(unit, better, worst, meaning, compute, axis, recorded, module)
        return function

    return register
