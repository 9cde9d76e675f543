"""Build the report of an experiment, a folder that needs no network, from its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dcreg.plot import packing
from reports import sections, templating, theme
from reports.page import Page
from reports.tables import Tables
from workflows.discovery import modules

HERE = Path(__file__).parent


def build(tables_dir: Path, out: Path) -> None:
    """Write the report of the tables in `tables_dir` to `out`, with data and figures next to it.

    Parameters
    ----------
    tables_dir : Path
        ``results/<experiment>/tables``.
    out : Path
        The HTML file; ``data/`` in its folder has what the page loads on demand, ``figures/`` the static
        figures.

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
    page.write_data(out.parent)
    out.write_text(_render(page, parts), encoding="utf-8")


def _render(page: Page, parts: list[tuple[Any, dict[str, Any]]]) -> str:
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
    return environment.get_template("page.html").render(
        sections=bodies,
        css=_assets("css"),
        variables=theme.css_variables(page.styles.values()),
        script=packing.UNPACK.read_text(encoding="utf-8") + _assets("js"),
    )


def _assets(kind: str) -> str:
    """Return the style sheets or scripts of the page, one after the other."""
    paths = [HERE / "assets" / f"{name}.{kind}" for name in ("report", "runs", "run")]
    return "\n".join(path.read_text(encoding="utf-8") for path in paths if path.is_file())
