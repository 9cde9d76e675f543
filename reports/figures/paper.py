"""What a figure of the paper shows, which results ours needs, and how it differs.

A module of `reports.figures.standalone` with an attribute ``PAPER`` is one figure of the paper.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from reports.ledger.book import ledger
from reports.ledger.evidence import Experiment
from reports.tables import Tables

# Endings of an experiment's name, the preferred first: everything, small clouds, quick parts.
TIERS = ("", "-40", "-quick", "-40-quick")


# Line of a figure -> the roles of the ledger that draw it; the first that ran is drawn.
LINES: dict[str, tuple[str, ...]] = {
    "DC-Reg, n_p × 1/1": ("dcreg_paper",),
    "DC-Reg, n_p × 1/2": ("dcreg_paper_half",),
    "DC-Reg (ours)": ("dcreg",),
    "RPM-HTB": ("rpm_htb",),
    "RPM-PA": ("rpm_pa",),
    "RPM-CAV": ("rpm_cav",),
    "Go-ICP": ("goicp", "goicps"),
    "FRS": ("frs", "frs_scan"),
    "GORE": ("gore", "gore_scan"),
    "TEASER++": ("teaser", "teaser_scan"),
}


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
    lines : tuple of str
        The methods of the paper's figure, names of `LINES`.
    """

    caption: str
    differs: tuple[str, ...]
    experiment: str = ""
    command: str = ""
    lines: tuple[str, ...] = ()

    def methods(self, tables: Tables) -> dict[str, str]:
        """Return the attempted method of each line by the line's name, in the order of the lines."""
        experiment, roles = Experiment(tables), ledger().roles
        found = {}
        for line in self.lines:
            fitting = [
                label for role in LINES[line] for label in experiment.methods_in(roles[role])
            ]
            if fitting:
                found[line] = fitting[0]
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
