"""The page of the library: ``python -m reports library``. One file that needs no network."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from data.library.problem import Problem, all_problems
from data.library.record import BoundEntry, Enumeration, PoseEntry, Record, read_record
from dcreg import __version__
from reports import templating, theme
from reports.archive.sources import CITATION
from reports.library import difficulty, drawing
from reports.page import pack_json
from workflows import CHECKOUT

WORDS = {
    "easy": "proven by default options within 60 s of CPU time",
    "hard": "proven with other options, in more time or by all matchings",
    "open": "not proven so far; the view states the CPU time of the longest search",
}
BIBTEX = """@misc{{dcreg-library-{key},
  title = {{Problem {id} of the DC-Reg problem library}},
  author = {{{author}}},
  year = {{{year}}},
  note = {{Version {dcreg} of the record. {origin}}}
}}"""


@dataclass(frozen=True)
class Row:
    """One problem in the table."""

    problem: Problem
    record: Record
    status: str
    thumbnail: str
    proven_by: str

    @property
    def n_points(self) -> int:
        return max(self.problem.n_source, self.problem.n_target)

    @property
    def is_enumerated(self) -> bool:
        """Whether all matchings prove the best lower bound."""
        bound = self.record.best_bound
        return bound is not None and isinstance(bound.proof, Enumeration)

    @property
    def optima(self) -> int | None:
        return None if self.record.optima is None else self.record.optima.count


def build(out: Path) -> Path:
    """Write the page, and the table of difficulty next to it.

    Parameters
    ----------
    out : Path
        A folder.

    Returns
    -------
    Path of the page.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = [_row(problem, read_record(problem.id)) for problem in all_problems().values()]
    table = difficulty.table(
        (row.problem, row.record) for row in rows if not row.problem.needs_files
    )
    table.to_csv(out / "difficulty.csv", index=False)
    html = templating.environment().get_template("library.html").render(
        variables=theme.css_variables([]),
        script=templating.script("library.js"),
        rows=rows,
        counts=Counter(row.status for row in rows),
        proven_3d=sum(row.status != "open" and row.problem.dim == 3 for row in rows),
        enumerated=sum(row.is_enumerated for row in rows),
        words=WORDS,
        families=sorted({row.problem.family for row in rows}),
        panels=drawing.panels(table),
        finding=difficulty.fit(table).sentence(),
        data=pack_json({row.problem.id: _details(row) for row in rows}),
        version=__version__,
    )  # fmt: skip
    page = out / "index.html"
    page.write_text(html, encoding="utf-8")
    return page


def _row(problem: Problem, record: Record) -> Row:
    bound = record.best_bound
    return Row(
        problem, record, record.status(problem), drawing.thumbnail(problem, record),
        "" if bound is None else bound.by,
    )  # fmt: skip


def _details(row: Row) -> dict[str, Any]:
    """Return what the view of one problem shows."""
    problem, record = row.problem, row.record
    best = record.best_pose
    details: dict[str, Any] = {
        "title": problem.title, "origin": problem.origin, "licence": problem.licence,
        "unit": problem.unit, "scale_range": problem.scale_range,
        "facts": _facts(row), "history": _history(record),
        "cite": BIBTEX.format(
            key=problem.name, id=problem.id, dcreg=__version__, origin=problem.origin, **_authorship()
        ),
    }  # fmt: skip
    if problem.needs_files:  # a picture only: the page must not distribute the points
        details["picture"] = drawing.picture(problem, record)
    if not problem.needs_files and best is not None:
        source, target = problem.clouds
        details |= {"source": source, "target": target, "pose": best.pose}
        details["truth"] = None if problem.truth is None else problem.truth.pose
    return details


@cache
def _authorship() -> dict[str, str]:
    """Return authors and year of the library, as a BibTeX entry states them."""
    citation = yaml.safe_load((CHECKOUT / CITATION).read_text(encoding="utf-8"))
    authors = (
        f"{{{author['name']}}}"
        if "name" in author
        else f"{author['family-names']}, {author['given-names']}"
        for author in citation["authors"]
    )
    return {"author": " and ".join(authors), "year": str(citation["date-released"])[:4]}


def _facts(row: Row) -> list[tuple[str, str]]:
    problem, record = row.problem, row.record
    best, bound, proof = record.best_pose, record.best_bound, record.certificate
    facts = {
        "status": f"{row.status}: {WORDS[row.status]}",
        "model": problem.model,
        "points": f"{problem.n_source} and {problem.n_target}",
        "n_inliers": str(problem.n_inliers),
        "best known objective": "" if best is None
        else f"{best.objective:.9g} ({best.by}, {best.how})",
        "proven lower bound": "" if bound is None
        else f"{bound.lower_bound:.9g} ({bound.by}, {bound.how})",
        "gap": f"{100 * record.gap:.2f} %",
        "longest search": f"{record.tried_s:.1f} s of CPU time" if row.status == "open" else "",
        "distinct optima": "" if record.optima is None
        else f"{record.optima.count} ({record.optima.how})",
        "proof": "" if proof is None else f"{proof.n_leaves:,} leaf boxes, {proof.size / 1000:.0f} kB, "
        + (f"checked in {proof.check_s:.1f} s" if proof.stored else f"not stored; {proof.command}"),
    }  # fmt: skip
    for entry in record.solves:
        options = ", ".join(entry.options) or "default options"
        facts[f"solve by {entry.by}, {options}"] = (
            f"{entry.status}, {entry.cpu_s:.2f} s of CPU time"
        )
    return [(name, text) for name, text in facts.items() if text]


def _history(record: Record) -> list[dict[str, Any]]:
    """Return the best objective and bound after each entry that changed one of them."""
    upper: float | None = None
    lower: float | None = None
    steps = []
    for entry in record.entries:
        if isinstance(entry, PoseEntry):
            upper = entry.objective if upper is None else min(upper, entry.objective)
        elif isinstance(entry, BoundEntry):
            lower = entry.lower_bound if lower is None else max(lower, entry.lower_bound)
        else:
            continue
        steps.append({"by": entry.by, "date": entry.date, "upper": upper, "lower": lower})
    return steps
