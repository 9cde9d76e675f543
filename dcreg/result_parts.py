"""Parts of a result: bound history, stages, sample searched, score of matches, runner-up pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dcreg import text
from dcreg.files import as_json, plain, write_text
from dcreg.search import Confined, Event, Outcome, proven_share
from dcreg.status import Status

_SHOWN = 10  # numbers of pairs in a summary


@dataclass
class Trace:
    """Bound history of one run; iteration yields its events in order.

    Attributes
    ----------
    events : list of Event
    """

    events: list[Event] = field(default_factory=list)

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def rows(self) -> list[dict[str, object]]:
        """Return one dictionary of plain values per event, for tables and figures."""
        return [dict(vars(event)) for event in self.events]

    def write_jsonl(self, path: str | Path) -> None:
        """Write one JSON object per line; the last one has kind ``end`` and the status.

        An infinite bound becomes null.
        """
        write_text(path, "".join(as_json(row, indent=None) + "\n" for row in self.rows()))


@dataclass(frozen=True)
class MemoryEstimate:
    """The memory that a solve was expected to need, estimated before it began.

    Attributes
    ----------
    peak_mb : float
        Peak memory of the process, without what grows with the length of the search: the values that a
        bounding function stores about boxes, and the open boxes.
    stored_mb : float
        Maximum size of these values.
    box_bytes : int
        Size of an open box.
    """

    peak_mb: float
    stored_mb: float
    box_bytes: int

    def __str__(self) -> str:
        return (
            f"{self.peak_mb:,.0f} MB; a long search needs up to {self.stored_mb:,.0f} MB more, and "
            f"{text.count(self.box_bytes, 'byte')} for each open box"
        )


@dataclass(frozen=True)
class Stage:
    """Bounds, work and time of one stage of a solve.

    Attributes
    ----------
    name : str
        ``n_inliers`` (the choice of the number of pairs), ``search``, ``rotation``, ``rigid``,
        ``triples``, ``distances``, ``feasible pairs``, ``polish``, ``pairs``, ``all points``; in sweeps
        also ``local searches``; in `dcreg.register_matches` ``start`` and ``rotation``.
    time_s : float
    n_nodes, n_assignments : int
    status : Status, optional
        None if the stage has no bounds.
    lower_bound, upper_bound : float, optional
        Bounds on the objective of this stage.
    gap_tol : float, optional
        The tolerance of this stage, if it differs from the one of the solve.
    objective_before, objective_after : float, optional
        Sum of squared residuals of the matched pairs before and after the polish.
    greedy_assignment : bool, optional
        True if the time limit was hit before the pairs were matched, so that they were chosen greedily.
    n_tried, n_boxes : int, optional
        Of ``triples`` and ``distances``: the congruent triples or the boxes tried, and the boxes to which
        the following search is confined.
    outside : float, optional
        Of ``triples`` and ``distances``: a lower bound on the objective of every optimum
        outside these boxes.
    """

    name: str
    time_s: float
    n_nodes: int = 0
    n_assignments: int = 0
    status: Status | None = None
    lower_bound: float | None = None
    upper_bound: float | None = None
    gap_tol: float | None = None
    objective_before: float | None = None
    objective_after: float | None = None
    greedy_assignment: bool | None = None
    n_tried: int | None = None
    n_boxes: int | None = None
    outside: float | None = None

    @classmethod
    def confining(cls, confined: Confined) -> Stage:
        """Return the stage that confined a search to few boxes."""
        return cls(
            confined.stage, confined.time_s, n_tried=confined.n_tried, n_boxes=len(confined.boxes),
            outside=confined.outside,
        )  # fmt: skip

    @classmethod
    def of(cls, name: str, found: Outcome, gap_tol: float | None = None) -> Stage:
        """Return the stage of one search."""
        return cls(
            name, found.time_s, found.n_nodes, found.n_assignments, found.status,
            found.lower_bound, found.upper_bound, gap_tol,
        )  # fmt: skip

    def scaled(self, factor: float) -> Stage:
        """Return the stage with its bounds multiplied by `factor`."""
        names = ("lower_bound", "upper_bound", "gap_tol", "outside")
        present = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(self, **{name: factor * value for name, value in present.items()})

    def summary(self) -> str:
        """Return one line about a stage that has bounds."""
        low, high = self.lower_bound or 0.0, self.upper_bound or 0.0
        is_exact = self.status is Status.OPTIMAL and low <= 0.0
        share = "exact fit" if is_exact else text.percent(proven_share(low, high))
        work = f"{text.count(self.n_nodes, 'node')}, {self.time_s:.2f} s"
        return f"{self.status}, bounds [{low:.5g}, {high:.5g}] ({share}), {work}"

    def confinement(self) -> str:
        """Return one line about a stage that confined a search."""
        count = self.n_tried or 0
        if self.name == "triples":
            tried = text.count(count, "congruent triple")
        else:
            tried = f"distances in {text.count(count, 'box', 'boxes')}"
        if not self.n_boxes:
            return (
                f"{tried} prove that no objective is below {self.outside:.5g}, {self.time_s:.2f} s"
            )
        boxes = text.count(self.n_boxes, "box", "boxes")
        return (
            f"{tried} prove that an optimum below {self.outside:.5g} lies in {boxes}, "
            f"{self.time_s:.2f} s"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, without the values that the stage lacks."""
        values = {"stage": self.name, **vars(self)}
        del values["name"]
        return plain({key: value for key, value in values.items() if value is not None})


class Sample(NamedTuple):
    """Sizes of the downsampled problem that was searched.

    Attributes
    ----------
    n_source, n_target : int
        Points of each cloud.
    n_inliers : int
        Pairs to match.
    """

    n_source: int
    n_target: int
    n_inliers: int


class Score(NamedTuple):
    """Score of a pose over a list of matches.

    A chosen match counts ``1 - (residual / inlier_distance)**2``.

    Attributes
    ----------
    reached : float
        Score of the pose found.
    upper_bound : float
        Proven upper bound on the score of any pose.
    """

    reached: float
    upper_bound: float


class ComparedNumber(NamedTuple):
    """A number of pairs that was compared with others.

    Attributes
    ----------
    n_inliers : int
    rms : float
        RMS residual of the cheapest pairs at the pose, in units of the target; with more than 40,000
        point pairs that of source points to their nearest target points.
    """

    n_inliers: int
    rms: float


class ProvenNumber(NamedTuple):
    """Proven bounds on the largest number of pairs within a distance.

    Attributes
    ----------
    distance : float
        In units of the target.
    at_least : int
        Number of pairs of the result within the distance.
    at_most : int
        No pose has more pairs within the distance.
    """

    distance: float
    at_least: int
    at_most: int


@dataclass(frozen=True)
class ChosenNumber:
    """The evidence for the number of pairs that the library chose; only `proven` is proven.

    Attributes
    ----------
    compared : list of ComparedNumber
        In ascending order, all at the pose that gave the chosen number. Empty if there was no time to
        compare.
    low, high : int
        The numbers from `low` to `high` fit nearly as well.
    runner_up : int, optional
        Another number of pairs, which fits nearly as well at a clearly different pose.
    is_cut : bool
        Whether the time limit or the listener ended the comparison before all poses and numbers were
        compared.
    proven : ProvenNumber, optional
        At this distance, about the RMS residual, there are fewer pairs than the chosen number at every
        pose. It follows from the lower bound. None if that is 0 or refers to a sample or to weights.
    """

    compared: list[ComparedNumber]
    low: int
    high: int
    runner_up: int | None = None
    is_cut: bool = False
    proven: ProvenNumber | None = None

    def __str__(self) -> str:
        return self._comparison() + (
            ""
            if self.proven is None
            else f"\nproven: the largest number of pairs that can all be within "
            f"{self.proven.distance:.3g} is {self.proven.at_least} to {self.proven.at_most}"
        )

    def _comparison(self) -> str:
        if not self.compared:
            return "not compared with others"
        step = -(-len(self.compared) // _SHOWN)
        shown = ", ".join(f"{k}: {rms:.3g}" for k, rms in self.compared[::-step][::-1])
        near = f"{self.low} to {self.high} pairs fit nearly as well"
        if self.low == self.high:  # fewer pairs may fit better than the smallest number compared
            is_least = self.low == self.compared[0].n_inliers
            near = (
                "the smallest number compared"
                if is_least
                else "no other number compared fits nearly as well"
            )
        cut = "; not all poses and numbers were compared" * self.is_cut
        return f"{near}{cut}\nRMS residual at the pose of this choice, by number of pairs: {shown}"


@dataclass(frozen=True)
class RunnerUp:
    """The best distinct pose that a local search found; a better one may exist.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    objective_ratio : float
        Objective of this pose divided by the objective of the result. If it is near 1, the data hardly
        distinguish the two poses.
    rotation_difference_deg : float
        Angle between the two rotations.
    rms_displacement : float
        RMS distance between the source points moved by one pose and by the other, in units of the target.
    """

    T_target_source: np.ndarray
    objective_ratio: float
    rotation_difference_deg: float
    rms_displacement: float

    def __str__(self) -> str:
        ratio = f"{self.objective_ratio:.3g}" if self.objective_ratio < 1000 else "over 1000"
        return (
            f"{ratio} times the objective, {self.difference} (the best one found that clearly differs; "
            "not proven)"
        )

    @property
    def difference(self) -> str:
        """Its difference from the pose of the result, in words."""
        return (
            f"displaced by {self.rms_displacement:.3g} (RMS), "
            f"rotated by {self.rotation_difference_deg:.0f} deg"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return plain(self)
