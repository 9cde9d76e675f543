"""Build the report of an experiment, a folder that needs no network, from its tables."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from reports import sections, templating, theme
from reports.page import Page, write_data
from reports.tables import Tables
from workflows.discovery import modules

HISTORY = Path("history", "index.html")  # of all versions, in the folder of all results
WHOLE = "whole.html"  # the same page in one file, to be sent or to be part of another report
# The first one is needed by the others.
SCRIPTS = ("report.js", "fold.js", "versus.js", "runs.js", "cards.js", "run.js")


def build(tables_dir: Path, out: Path) -> None:
    """Write the report of the tables in `tables_dir` to `out`, with data and figures next to it.

    Parameters
    ----------
    tables_dir : Path
        ``results/<experiment>/tables``.
    out : Path
        The HTML file; ``data/`` in its folder has what the page loads on demand, ``figures/`` the static
        figures, and `WHOLE` is the page with its data in one file.

    Raises
    ------
    ReportError, SchemaError
        When a table is missing or incomplete, or when planned runs and outcomes do not add up.
    """
    out = Path(out)
    tables = Tables.load(Path(tables_dir))
    page = Page(tables, theme.method_styles(tables), out.parent / "figures")
    order = sorted(modules(sections), key=lambda section: section.POSITION)
    found = ((part, part.context(page)) for part in order)
    parts = [(part, context) for part, context in found if context is not None]
    out.parent.mkdir(parents=True, exist_ok=True)
    render = _renderer(page, parts)
    data = page.packed()
    write_data(data, out.parent)
    out.write_text(render(inside={}, history=_history_from(out.parent)), encoding="utf-8")
    out.with_name(WHOLE).write_text(render(inside=data, history=""), encoding="utf-8")


def _history_from(folder: Path) -> str:
    """Return the relative address of the page of the history; empty if there is none.

    A report is in ``results/NAME/report``, or in ``results/NAME/parts/PART/report``.
    """
    places = [parent / HISTORY for parent in folder.resolve().parents[:4]]
    page = next(filter(Path.is_file, places), None)
    return Path(os.path.relpath(page, folder.resolve())).as_posix() if page else ""


def _renderer(page: Page, parts: list[tuple[Any, dict[str, Any]]]) -> Callable[..., str]:
    """Return a function that renders the page with data `inside` it, by name."""
    environment = templating.environment()
    environment.filters |= {
        "number": theme.number,
        "percent": theme.percent,
        "proven": theme.proven,
        "seconds": theme.seconds,
        "integer": theme.integer,
        "sortable": theme.sortable,
        "words": theme.words,
    }
    environment.globals |= {"page": page, "cards": page.tables.cards, "styles": page.styles}
    bodies = [
        {
            "id": part.ID,
            "title": part.TITLE,
            "html": environment.get_template(f"sections/{part.ID}.html").render(context),
        }
        for part, context in parts
    ]
    return functools.partial(
        environment.get_template("page.html").render,
        sections=bodies,
        variables=theme.css_variables(page.styles.values()),
        script=templating.script(*SCRIPTS),
    )
