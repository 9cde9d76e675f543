"""The result of a search for other poses that are nearly as good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.files import as_json, plain, write_text
from dcreg.result import Result
from dcreg.status import Status


@dataclass(frozen=True)
class Alternative:
    """Another pose with an objective below the threshold.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    objective : float
    angle_deg : float
        Angle of its rotation relative to that of the best pose.
    displacement : float
        RMS displacement of the source points relative to the best pose, in units of the target.
    """

    T_target_source: np.ndarray
    objective: float
    angle_deg: float
    displacement: float


@dataclass(frozen=True, repr=False)
class Alternatives:
    """The poses that are nearly as good as the best one; see `dcreg.alternatives`.

    Attributes
    ----------
    status : Status
        ``optimal`` if the list is proven to be complete.
    result : Result
        The best pose.
    distance : float
        Poses count as distinct if they displace the source points by more than this (RMS), in units of
        the target.
    threshold : float
        The objective up to which poses are listed, in squared units of the target.
    lower_bound : float
        No pose farther than `distance` from all listed ones has a lower objective.
    others : list of Alternative
        Each farther than `distance` from the best pose and from those before it.
    time_s : float
    """

    status: Status
    result: Result
    distance: float
    threshold: float
    lower_bound: float
    others: list[Alternative]
    time_s: float

    @property
    def is_complete(self) -> bool:
        """Whether it is proven that no other pose has an objective up to the threshold."""
        return self.status is Status.OPTIMAL

    @property
    def is_unique(self) -> bool:
        """Whether it is proven that only the best pose has an objective up to the threshold."""
        return self.is_complete and not self.others

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("status", "is_complete", "is_unique", "distance", "threshold", "lower_bound")
        values = {name: getattr(self, name) for name in names}
        others = [vars(each) for each in self.others]
        return plain({**values, "others": others, "result": self.result.to_dict()})

    def to_json(self, **more: Any) -> str:
        """Return `to_dict`, the version and `more` keys as JSON."""
        return as_json({**self.to_dict(), **more, "dcreg_version": __version__})

    def write_json(self, path: str | Path, **more: Any) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.to_json(**more) + "\n")

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary; every warning is an entry of that name."""
        yield "answer", self._answer()
        yield "distinct from", f"an RMS displacement of {self.distance:.4g}"
        yield "threshold", f"objective {self.threshold:.6g}"
        if not self.is_complete:
            yield "lower bound", f"{self.lower_bound:.6g} of any pose that is not listed"
        for each in self.others:
            yield (
                "other pose",
                f"objective {each.objective:.6g}, rotated by {each.angle_deg:.4g} deg and displaced by "
                f"{each.displacement:.4g} (RMS) relative to the best pose",
            )
        yield "time", f"{self.time_s:.2f} s"
        yield "best pose", self.result.summary()

    def _answer(self) -> str:
        others = text.count(len(self.others), "other pose")
        if self.is_unique:
            return "unique: no distinct pose is nearly as good; proven"
        if self.is_complete:
            return f"{others} nearly as good; proven to be all"
        if self.others:
            return f"at least {others} nearly as good; {self.status.value}"
        return f"no other pose is known, but one may exist ({self.status.value})"

    def __str__(self) -> str:
        return text.listing(list(self.entries()))

    def __repr__(self) -> str:
        return f"<Alternatives {self._answer()}>"
