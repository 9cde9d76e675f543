"""What a figure of the paper shows, which results ours needs, and how it differs.

A module of `reports.figures.standalone` with an attribute ``PAPER`` is one figure of the paper.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reports.tables import Tables
from workflows.outcomes import attempted

# Endings of an experiment's name, the preferred first: everything, small clouds, quick parts.
TIERS = ("", "-40", "-quick", "-40-quick")


@dataclass(frozen=True)
class Line:
    """A method of the paper, recognised by baseline, share of the pairs and options in effect."""

    name: str
    baselines: tuple[str, ...]
    ratio: float = 1.0
    options: Mapping[str, Sequence[Any]] = field(default_factory=dict)  # accepted, best first

    def rank(self, card: Mapping[str, Any]) -> tuple[int, ...] | None:
        """Return a sort key of a method that fits, the best first; None for one that does not."""
        effective = options_of(card)
        if card.get("baseline") not in self.baselines or card["n_inliers_ratio"] != self.ratio:
            return None
        if any(effective.get(name) not in values for name, values in self.options.items()):
            return None
        ranks = [list(values).index(effective.get(name)) for name, values in self.options.items()]
        changed = len(set(card.get("options", {})) - set(self.options))  # plain methods first
        return (self.baselines.index(card["baseline"]), *ranks, changed)


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper.

    Attributes
    ----------
    caption : str
        What the paper's figure shows, in our words.
    differs : tuple of str
        How ours differs.
    experiment : str
        The experiment whose tables are drawn; empty if the figure needs none.
    command : str
        What makes these tables.
    lines : tuple of Line
        The methods of the paper's figure.
    """

    caption: str
    differs: tuple[str, ...]
    experiment: str = ""
    command: str = ""
    lines: tuple[Line, ...] = ()

    def methods(self, tables: Tables) -> dict[str, str]:
        """Return the attempted method of each line by the line's name, in the order of the lines."""
        present = set(attempted(tables.runs)["method"])
        cards = {
            label: {"n_inliers_ratio": 1.0, "baseline": label, **card}
            for label, card in tables.cards.items()
            if label in present
        }
        found = {}
        for line in self.lines:
            ranks = {label: line.rank(card) for label, card in cards.items()}
            fitting = [label for label in ranks if ranks[label] is not None]
            if fitting:
                found[line.name] = min(fitting, key=lambda label: ranks[label] or ())
        return found

    def find_tables(self, results: Iterable[Path]) -> Path | None:
        """Return the folder of the preferred tables in folders of results.

        A whole experiment comes before a selected part of it; of several parts, the last written one.
        """
        folders = list(results)
        for tier, folder in itertools.product(TIERS if self.experiment else (), folders):
            place = folder / f"{self.experiment}{tier}"
            parts = sorted(
                place.glob("parts/*/tables/accounting.csv"), key=lambda path: path.stat().st_mtime
            )
            found = [
                path for path in (*parts, place / "tables" / "accounting.csv") if path.is_file()
            ]
            if found:
                return found[-1].parent
        return None


def options_of(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options in effect: the card's defaults and those given."""
    return {**card.get("parameters", {}), **card.get("options", {})}


def lines(*names: str) -> tuple[Line, ...]:
    """Return the lines of these names."""
    return tuple(_LINES[name] for name in names)


# The search of the method itself, not ours; without the option there is only one.
_OWN: dict[str, Sequence[Any]] = {"search": ("own", None)}
# The true pairs among random ones are never a front end of the paper.
_FRONT: dict[str, Sequence[Any]] = {
    "front_end": ("norm-signature", None, "shared-mutual", "fpfh-mutual", "shared-nearest"),
    "threshold": ("paper", None, "given"),
}
_DEFAULT: dict[str, Sequence[Any]] = {
    "bound": (None, "tight"),
    "mode": (None, "auto", "full"),
    "front_end": (None,),
}
_LINES = {
    line.name: line
    for line in (
        Line("DC-Reg, n_p × 1/1", ("dcreg_paper",)),
        Line("DC-Reg, n_p × 1/2", ("dcreg_paper",), 0.5),
        Line("DC-Reg (ours)", ("dcreg",), options=_DEFAULT),
        Line("RPM-HTB", ("rpm_htb",), options=_OWN),
        Line("RPM-PA", ("rpm_pa",), options=_OWN),
        Line("RPM-CAV", ("rpm_cav",), options=_OWN),
        Line(
            "Go-ICP",
            ("goicp", "py_goicp"),
            # a cube of translations that contains every truth, before one that does not
            options={"translation_half_width": (None, 0.5)},
        ),
        Line("FRS", ("frs",), options={"threshold": _FRONT["threshold"]}),
        Line("GORE", ("gore",), options=_FRONT),
        Line("TEASER++", ("teaserpp", "teaser"), options=_FRONT),
    )
}
