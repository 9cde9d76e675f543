"""The one contract between the harness and every registration method.

A method is a folder ``baselines/<name>/`` with ``card.yaml`` (facts) and ``adapter.py`` (a class
``Adapter(Baseline)``). No other file is edited to add one. An adapter receives an `Instance`, without the
true pose. The harness measures its time and computes all metrics.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from dcreg.status import Status

if TYPE_CHECKING:
    from dcreg.search import Budget

ModelName = Literal["similarity2d", "rigid3d"]

# `Instance.noise_bound` in RMS residuals of the true pairs at the reference pose. With Gaussian noise it
# contains 98 % (2D) or 99 % (3D) of the pairs.
NOISE_FACTOR = 2.0


class ThresholdRule(BaseModel):
    """The rule of the option ``threshold: paper``: the greater of a quantile of noise and a spacing."""

    model_config = ConfigDict(extra="forbid")

    text: str  # the rule as stated, and where
    # The method's paper, its authors' code, a textbook, or us where we could read none of them.
    origin: Literal["paper", "code", "textbook", "ours"]
    confidence: float | None = Field(None, gt=0, lt=1)  # share of true pairs within, Gaussian noise
    spacings: float | None = Field(
        None, gt=0
    )  # in mean distances to the nearest point of the cloud

    @model_validator(mode="after")
    def _states_a_length(self) -> ThresholdRule:
        if self.confidence is None and self.spacings is None:
            raise ValueError("threshold_rule: give confidence, spacings or both")
        return self

    def distance(self, instance: Instance) -> float:
        """Return the threshold in target units, for the noise behind the noise bound of the instance."""
        return max(self._quantile(instance), self._resolution(instance))

    def _quantile(self, instance: Instance) -> float:
        from scipy.stats import chi2

        if self.confidence is None:
            return 0.0
        sigma = instance.noise_bound / (NOISE_FACTOR * np.sqrt(instance.dim))
        return float(sigma * np.sqrt(chi2.ppf(self.confidence, instance.dim)))

    def _resolution(self, instance: Instance) -> float:
        from scipy.spatial import cKDTree

        if self.spacings is None:
            return 0.0
        clouds = (instance.source, instance.target)
        means = [cKDTree(points).query(points, k=2)[0][:, 1].mean() for points in clouds]
        return float(self.spacings * np.mean(means))


class Range(BaseModel):
    """The numbers that an option admits; for a list, each entry."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    above: float | None = None
    least: float | None = None
    below: float | None = None
    most: float | None = None
    or_null: bool = False

    def __str__(self) -> str:
        limits = {
            "above": self.above, "at least": self.least, "below": self.below, "at most": self.most,
        }  # fmt: skip
        said = [f"{word} {limit:.12g}" for word, limit in limits.items() if limit is not None]
        number = ", ".join(filter(None, ["a finite number", " and ".join(said)]))
        return f"{number}, or null" if self.or_null else number

    def admits(self, value: Any) -> bool:
        """Return whether `value`, a number, a list of numbers or null, is in the range."""
        if value is None:
            return self.or_null
        if isinstance(value, list):
            return all(self.admits(entry) for entry in value)
        return (
            math.isfinite(value)
            and (self.above is None or value > self.above)
            and (self.least is None or value >= self.least)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
        )


class Card(BaseModel):
    """The facts about a method that a report shows. Validated ``card.yaml``."""

    model_config = ConfigDict(extra="forbid")

    display_name: str
    summary: str
    # Raised by the author when results change; `python -m workflows versions` checks it.
    version: int = Field(default=1, ge=1)
    models: list[ModelName]
    # official: the authors' own code; library: third-party code; port: our code for the algorithm in a
    # paper or in its authors' public code; reconstruction: our code, written without the full paper or
    # the authors' code; own: a method of the user.
    provenance: Literal["official", "library", "port", "reconstruction", "own"]
    # Language and origin of the code that takes the time; reports state it next to times.
    language: str = Field(default="Python", min_length=1)
    input: str = "raw point sets"  # e.g. "FPFH correspondences"
    provides_bounds: bool = False
    certifies: str = "nothing"  # scope of the certificate
    uses_n_inliers: bool = False
    # Whether the method counts exact assignments (`n_assignments`) and stops at ``limits.assignments``.
    solves_assignments: bool = False
    one_to_one: bool = False
    needs_initial_pose: bool = False
    deterministic: bool = True
    requires: str = ""  # importable module, empty when nothing beyond the lock file
    how_to_get: str = ""  # shown when unavailable
    citation: str
    licence: str
    url: str = ""
    # Methods of a family share a colour, which reports adapt to both themes, and differ by marker.
    color: str = Field(pattern=r"^#[0-9a-fA-F]{6}$")
    marker: str = "o"
    # Parameters with their stated defaults, shown in the report.
    parameters: dict[str, Any] = {}
    ranges: dict[str, Range] = {}  # of the parameters that are numbers
    # Options with which the method runs the search of this library: its results then also depend on the
    # version of the method `dcreg`.
    library_search: dict[str, Any] = {}
    # Used by the option ``threshold: paper``.
    threshold_rule: ThresholdRule | None = None

    @model_validator(mode="after")
    def _defaults_lie_in_their_ranges(self) -> Card:
        for option, admitted in self.ranges.items():
            if option not in self.parameters:
                raise ValueError(f"ranges.{option}: no such parameter; correct the name")
            default = self.parameters[option]
            if default is not None and not admitted.admits(default):
                raise ValueError(f"parameters.{option}: {default!r} is not {admitted}")
        return self


@dataclass(frozen=True)
class Instance:
    """One registration problem, as a method receives it.

    Attributes
    ----------
    source, target : (n, d), (m, d) arrays
    model : "similarity2d" or "rigid3d"
    n_inliers : int
        The number of pairs given to the method; not always the true one.
    scale_range : (low, high)
        Admissible scale; (1, 1) in 3D.
    noise_bound : float
        `NOISE_FACTOR` times the RMS residual of the true pairs at the reference pose, in target units,
        and at least 0.01 of the target's longest side. Methods that need an inlier threshold use it, so
        that all receive the same prior.
    seed : int
        For methods that draw random numbers.
    oracle_pairs : (k, 2) array, optional
        True pairs and random pairs, unmarked. Only for methods with the option ``front_end: oracle``,
        whose results are labelled accordingly.
    matches : dict of (k, 2) arrays
        Putative pairs shared by all methods, by the name of their front end. Most datasets have none.
    """

    instance_id: str
    source: np.ndarray
    target: np.ndarray
    model: ModelName
    n_inliers: int
    scale_range: tuple[float, float]
    noise_bound: float
    seed: int
    oracle_pairs: np.ndarray | None = None
    matches: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        return int(self.source.shape[1])


@dataclass(frozen=True)
class Limits:
    """Limits of one run. A method stops by itself; the harness kills a worker well after them."""

    time_s: float
    nodes: int | None = None  # boxes; for a multi-start method, initial poses
    memory_mb: int | None = None
    threads: int = 1
    assignments: int | None = None  # exact ones of each search; ignored by methods that solve none

    def budget(self) -> Budget:
        """Return the budget of time, work and memory of a run that starts now."""
        from dcreg.search import Budget

        return Budget(self.time_s, self.nodes, self.memory_mb, assignments=self.assignments)


@dataclass
class Solution:
    """The result of an adapter. The pose is required unless the method failed."""

    status: Status
    T_target_source: np.ndarray | None
    message: str = ""
    lower_bound: float | None = None
    upper_bound: float | None = None
    gap_tol: float | None = None
    certificate_scope: str = ""
    counters: dict[str, int] = field(default_factory=dict)  # n_nodes, n_assignments, ...
    # Rows with time_s, n_nodes, n_assignments, lower_bound, upper_bound (bounding methods only).
    trace: list[dict[str, Any]] = field(default_factory=list)
    extra: dict[str, float] = field(default_factory=dict)  # e.g. objective before the polish


class Baseline(abc.ABC):
    """A registration method.

    Parameters
    ----------
    **options
        Overrides of the card's ``parameters``. An unknown name is an error, and so is a name in
        `idle_options`.
    """

    card: Card
    options: dict[str, Any]

    def __init__(self, card: Card, **options: Any) -> None:
        unknown = sorted(set(options) - set(card.parameters))
        if unknown:
            raise ValueError(
                f"{card.display_name}: unknown option {unknown[0]!r}; "
                f"it has {sorted(card.parameters) or 'no options'}"
            )
        self.card = card
        self.options = {**card.parameters, **options}
        threshold = self.options.get("threshold", "given")
        if threshold not in ("given", "paper"):
            raise ValueError(f"option threshold = {threshold!r}; choose one of given, paper")
        idle = self.idle_options()
        for option in options:
            if option in idle:
                raise ValueError(
                    f"option {option} = {options[option]!r} has no effect {idle[option]}; leave it out"
                )

    def idle_options(self) -> dict[str, str]:
        """Return the options without effect under the other options, each with the reason.

        A method that receives one of them is refused, since reports would show a value that had no
        effect. Overrides read ``self.options`` only: the call precedes the checks of a subclass.
        """
        if self.options.get("threshold") == "paper":
            return {"noise_factor": "with threshold: paper"}
        return {}

    def available(self) -> str | None:
        """Return None if the method can run here, otherwise the reason and how to get it."""
        from importlib import import_module

        if not self.card.requires:
            return None
        try:
            import_module(self.card.requires)
        except Exception as error:  # the import of a broken binary raises any type
            return f"{self.card.requires}: {error}. {self.card.how_to_get}".strip()
        return None

    def supports(self, instance: Instance) -> str | None:
        """Return None if the method can treat this instance, otherwise the reason."""
        if instance.model not in self.card.models:
            return f"{self.card.display_name} does not support {instance.model}"
        return None

    def inlier_distance(self, instance: Instance) -> float:
        """Return the maximum residual of an inlier, in target units.

        It is the noise bound of the instance times the option ``noise_factor``, or, with
        ``threshold: paper``, that of the rule of the card.
        """
        rule = self.card.threshold_rule
        if rule is not None and self.options["threshold"] == "paper":
            return rule.distance(instance)
        return float(self.options["noise_factor"] * instance.noise_bound)

    def warm_up(self, instance: Instance) -> None:
        """Import and compile what instances of this kind need; timed separately from `solve`."""
        self.solve(tiny(instance), Limits(time_s=30.0))

    @abc.abstractmethod
    def solve(self, instance: Instance, limits: Limits) -> Solution:
        """Return the best pose found for `instance` within `limits`."""


@runtime_checkable
class BoxBounding(Protocol):
    """Optional: an adapter with this method can bound its objective over a box of poses.

    ``python -m workflows.studies.bounds`` finds such adapters and compares their bounds with the DC bound
    on the same boxes.
    """

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return the lower bound of the method over one box, in squared units of the instance.

        The clouds are neither centred nor scaled. The box is of

        - ``similarity2d``: theta = (s cos a, s sin a, t_x, t_y), so that y = s R x + t; the objective is
          the sum of squared residuals of the best matching of ``n_inliers`` pairs;
        - ``rigid3d``: the translation t before the rotation, y = R (x + t), for any R; the objective is
          that of point norms, ``sum p_ij (|x_i + t| - |y_j|)^2``, or the method's counterpart.

        The bound holds for every admissible pose of the box. It is neither cut at zero nor inherited from
        another box. NaN if the method has no bound over such boxes.
        """
        ...


def tiny(instance: Instance) -> Instance:
    """Return a small problem with the same types of arrays, for warm-up."""
    generator = np.random.default_rng(0)
    points = generator.standard_normal((12, instance.dim))
    return Instance(
        instance_id="warm-up",
        source=points,
        target=points + 0.3,
        model=instance.model,
        n_inliers=9,
        scale_range=instance.scale_range,
        noise_bound=0.05,
        seed=0,
    )
