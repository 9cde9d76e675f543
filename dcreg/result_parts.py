"""Parts of a result: bound history, sample that was searched, score of matches, runner-up pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dcreg.files import as_json, plain, write_text
from dcreg.search.budget import Event


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
        RMS distance between the two images of the source, in units of the target.
    """

    T_target_source: np.ndarray
    objective_ratio: float
    rotation_difference_deg: float
    rms_displacement: float

    def __str__(self) -> str:
        ratio = f"{self.objective_ratio:.3g}" if self.objective_ratio < 1000 else "over 1000"
        return (
            f"{ratio} times the objective, {self.difference} (the best one found that is displaced by "
            "more than a fifth of the RMS radius of the target; not proven)"
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
