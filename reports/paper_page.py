"""The figures of the paper: ``python -m reports figures``, and one: ``python -m reports figure NAME``.

Every figure is written as SVG and PDF, and to a page that needs no network and follows the reader's light
or dark theme. A figure whose tables are missing is listed with the command that makes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd

from reports import templating, theme
from reports.figures import printing, standalone
from reports.figures.figure import Figure
from reports.tables import ReportError, Tables, limits_of
from workflows import UserError
from workflows.discovery import modules
from workflows.outcomes import attempted


@dataclass(frozen=True)
class Entry:
    """One figure on the page."""

    name: str
    module: ModuleType
    files: tuple[Path, ...] = ()
    wide: str = ""  # SVG
    stacked: str = ""  # SVG for a phone
    facts: tuple[tuple[str, str], ...] = ()
    missing: str = ""  # why there is no drawing

    @property
    def title(self) -> str:
        text = self.module.TITLE.removeprefix("Paper: ")
        return text[0].upper() + text[1:]


def paper_modules() -> dict[str, ModuleType]:
    """Return the modules of the paper's figures by name, in the paper's order."""
    found = [module for module in modules(standalone) if hasattr(module, "PAPER")]
    found.sort(key=lambda module: module.POSITION)
    return {module.__name__.rpartition(".")[2]: module for module in found}


def build(
    out: Path,
    results: Sequence[Path] = (Path("results"),),
    names: Sequence[str] = (),
    tables: Path | None = None,
) -> Path:
    """Write figures and their page to the folder `out`; return the path of the page.

    Parameters
    ----------
    out : Path
    results : sequence of Path
        Folders that contain the results of experiments.
    names : sequence of str
        The figures; default: all.
    tables : Path, optional
        The folder of tables to draw instead of those found in `results`.

    Raises
    ------
    ReportError
    """
    known = paper_modules()
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ReportError(f"no figure {unknown[0]!r}; choose one of {', '.join(known)}")
    entries = [_entry(name, known[name], out, results, tables) for name in names or known]
    page = out / (f"{names[0]}.html" if len(names) == 1 else "index.html")
    page.parent.mkdir(parents=True, exist_ok=True)
    html = templating.environment().get_template("figures.html").render(
        entries=entries
    )  # fmt: skip
    page.write_text(html, encoding="utf-8")
    return page


def _entry(
    name: str, module: ModuleType, out: Path, results: Sequence[Path], folder: Path | None
) -> Entry:
    paper = module.PAPER
    if not paper.experiment:
        return _drawn(Entry(name, module), module.build(None, {}), {}, out)
    given, folder = folder, folder or paper.find_tables(results)
    if folder is None:
        where = " or ".join(str(path) for path in results)
        return Entry(name, module, missing=f"{where} has no tables of {paper.experiment}.")
    try:
        tables = Tables.load(folder)
    except UserError as error:
        if given:
            raise
        return Entry(name, module, missing=f"{error}.")  # the other figures are drawn all the same
    styles = theme.method_styles(tables)
    entry = Entry(name, module, facts=_facts(tables, module))
    figure = module.build(tables, styles)
    if figure is None:
        why = f"{folder} has no runs of this figure's methods and tests."
        return Entry(name, module, facts=entry.facts, missing=why)
    return _drawn(entry, figure, styles, out)


def _drawn(entry: Entry, figure: Figure, styles: dict[str, theme.Style], out: Path) -> Entry:
    """Draw a figure for print and for both widths of the page."""
    assert figure.grid is not None
    svg = {}
    for stacked in (False, True):
        drawing = printing.draw(
            figure.traces, figure.grid, styles, "", entry.module.DRAWN, stacked=stacked,
            photographs=figure.photographs,
        )  # fmt: skip
        svg[stacked] = printing.inline(drawing, styles, f"{figure.id}{stacked}")
        if not stacked:
            files = printing.save(drawing, out / entry.name)
    return Entry(entry.name, entry.module, tuple(files), svg[False], svg[True], entry.facts)


def _facts(tables: Tables, module: ModuleType) -> tuple[tuple[str, str], ...]:
    """Return what was run, from the tables: data, levels, trials, limits, methods, origin."""
    shown = module.PAPER.methods(tables)
    runs = attempted(tables.runs)
    runs = runs[runs["method"].isin(shown.values())] if shown else runs
    known = tables.provenance
    limits = dict.fromkeys(
        ", ".join(limits_of(tables.cards.get(method, {})).values()) for method in shown.values()
    )
    lacking = [line for line in module.PAPER.lines if line not in shown]
    facts = {
        "experiment": tables.experiment,
        "shapes": ", ".join(dict.fromkeys(runs["shape"])) if runs["shape"].nunique() < 9
        else f"{runs['shape'].nunique()} scenes",
        "points": _span(runs["n_source"]),
        "trials per level": _span(runs.groupby(["method", "shape", "test", "level"]).size()),
        "levels": _levels(runs),
        "limits of a run": "; ".join(filter(None, limits)),
        "runs at a limit": f"{(runs['outcome'] == 'limited').sum()} of {len(runs)}",
        "methods of the paper without runs": ", ".join(lacking),
        "command": "; ".join(known.get("commands", [])),
        "commit": _commit(known.get("git", {})),
        "machine": _machine(known.get("machine", {})),
    }  # fmt: skip
    return tuple((name, text) for name, text in facts.items() if text)


def _span(values: pd.Series) -> str:
    """Return the range of some numbers in words."""
    if values.empty:
        return ""
    low, high = f"{values.min():g}", f"{values.max():g}"
    return low if low == high else f"{low} to {high}"


def _levels(runs: pd.DataFrame) -> str:
    return "; ".join(
        f"{theme.words(str(test))} " + ", ".join(f"{level:g}" for level in sorted(part.unique()))
        for test, part in runs.groupby("test", sort=False)["level"]
    )


def _commit(git: dict[str, Any]) -> str:
    changed = ", with changes" if git.get("dirty") else ""
    return f"{git['commit'][:10]}{changed}" if git.get("commit") else ""


def _machine(card: dict[str, Any]) -> str:
    return f"{card['cpu']}, {card['cores']} cores" if card else ""
