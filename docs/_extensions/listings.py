"""The directive ``listing``: tables of the documentation, generated from the code."""

import re
from collections.abc import Iterable
from pathlib import Path

import yaml
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).parents[2]


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [list(head), *(list(row) for row in rows)]
    cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
    cells.insert(1, ["---"] * len(cells[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def targets() -> str:
    """Targets of the Makefile, from the lines that `make help` prints."""
    found = re.findall(r"^## ([a-z0-9-]+): (.*)$", (ROOT / "Makefile").read_text("utf-8"), re.M)
    return table(("target", "purpose"), ((f"`make {name}`", text) for name, text in found))


def spelled(text: str) -> str:
    """Help text as Markdown, without accidental emphasis, with options as code."""
    return re.sub(r"(?<![\w`-])(--[a-z-]+)", r"`\1`", text.replace("*", "\\*"))


def options(command: str) -> str:
    """Options of one command of `dcreg`."""
    from typer.main import get_command

    from dcreg.cli.program import app

    rows = []
    for option in get_command(app).commands[command].params:
        names = " ".join([*option.opts, *option.secondary_opts])
        if option.param_type_name == "option":
            names = f"`{names}{f' {option.metavar}' if option.metavar else ''}`"
            need = "required. " if option.required else ""
            rows.append((names, need + spelled(option.help)))
    return table(("option", "meaning"), rows)


def modes() -> str:
    from dcreg.families.mode import all_modes

    def row(mode):
        bound = "its own" if mode.make_bound else f"any (default `{mode.own_bound}`)"
        return f"`{mode.model}`", f"`{mode.name}`", mode.summary, bound, mode.certifies and "yes"

    head = ("model", "mode", "search and certificate", "`bound`", "certificate file")
    return table(head, map(row, all_modes()))


def questions() -> str:
    """Which commands work with which model, mode and option."""
    from combinations import tables

    return tables()


def cards(folder: str) -> list[dict]:
    paths = sorted((ROOT / folder).glob("[a-z]*/card.yaml"))
    return [{"folder": p.parent.name, **yaml.safe_load(p.read_text("utf-8"))} for p in paths]


def methods() -> str:
    def row(card):
        models = ", ".join(
            sorted({"similarity2d": "2D", "rigid3d": "3D"}[m] for m in card["models"])
        )
        what = card.get("certifies", "nothing") if card.get("provides_bounds") else ""
        given = card.get("input", "raw point sets")
        facts = ("needs_initial_pose", "uses_n_inliers", "one_to_one")
        marks = ("yes" if card.get(fact) else "" for fact in facts)
        name = (
            f"`{card['folder']}`",
            card["display_name"],
            models,
            card["provenance"],
            card["language"],
        )
        return *name, given, *marks, what

    head = (
        *("folder", "method", "models", "provenance", "language", "input"),
        *("needs an initial pose", "uses `n_inliers`", "one-to-one", "its bounds certify"),
    )
    return table(head, map(row, cards("baselines")))


def datasets() -> str:
    def row(card):
        return f"`{card['name']}`", card["title"], card["licence"], card.get("notes", "")

    return table(("dataset", "title", "licence", "notes"), map(row, cards("data")))


def metrics() -> str:
    from workflows.metrics import METRICS

    better = {"none": ""}
    rows = (
        (f"`{name}`", metric.meaning, metric.unit, better.get(metric.better, metric.better))
        for name, metric in METRICS.items()
    )
    return table(("metric", "meaning", "unit", "better"), rows)


LISTINGS = {
    "targets": targets,
    "register-options": lambda: options("register"),
    "sweep-options": lambda: options("sweep"),
    "batch-options": lambda: options("batch"),
    "matches-options": lambda: options("register-matches"),
    "verify-options": lambda: options("verify"),
    "certify-options": lambda: options("certify"),
    "max-inliers-options": lambda: options("max-inliers"),
    "alternatives-options": lambda: options("alternatives"),
    "modes": modes,
    "questions": questions,
    "methods": methods,
    "datasets": datasets,
    "metrics": metrics,
}


class Listing(SphinxDirective):
    required_arguments = 1

    def run(self):
        text = LISTINGS[self.arguments[0]]()
        node = nodes.container()
        self.state.nested_parse(StringList(text.splitlines()), 0, node)
        return node.children


def setup(app):
    app.add_directive("listing", Listing)
    return {"parallel_read_safe": True}
