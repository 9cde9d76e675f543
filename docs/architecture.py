"""The picture of the library's parts, drawn from its imports: ``python docs/architecture.py``.

Writes ``docs/architecture.svg``. The tests draw it again and compare, and check that every arrow points
downwards. Where a part stands is said in `PARTS`; a new module at the top of the library goes there.
"""

from __future__ import annotations

import ast
import functools
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

HERE = Path(__file__).parent
LIBRARY = "dcreg"
PICTURE = HERE / "architecture.svg"


# --- the imports ----------------------------------------------------------------------------------


def imported_names(tree: ast.AST, package: str) -> set[str]:
    """Dotted names of all that a file imports, also within functions and for type checkers only.

    Parameters
    ----------
    tree : ast.AST
        The parsed file.
    package : str
        What relative imports refer to. ``from a import b`` gives ``a.b``.
    """
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                above = parts[: len(parts) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


@functools.cache
def files_of(library: str = LIBRARY) -> dict[str, list[Path]]:
    """The files of every module; a package that loads its names late lists them in a stub beside it."""
    files: dict[str, list[Path]] = {}
    for path in sorted((HERE.parent / library).rglob("*.py*")):
        if path.suffix in (".py", ".pyi"):
            parts = path.relative_to(HERE.parent).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            files.setdefault(name, []).append(path)
    return files


def names_imported_by(module: str, files: dict[str, list[Path]]) -> set[str]:
    """Dotted names of all that a module imports, of the library and others."""
    is_package = files[module][0].stem == "__init__"
    package = module if is_package else module.rpartition(".")[0]
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in files[module]]
    return set().union(*(imported_names(tree, package) for tree in trees))


def read_imports(library: str = LIBRARY) -> dict[str, set[str]]:
    """For every module of the library the modules of it that have to be loaded for its imports.

    These are the modules named and the packages they lie in, except those that hold the importing
    module as well.
    """
    files = files_of(library)
    found: dict[str, set[str]] = {}
    for module in files:
        needed = set()
        for name in names_imported_by(module, files):
            inside = [part for part in _with_parents(name) if part in files]
            if inside:
                around = set(_with_parents(module)) - {module}
                needed |= {inside[0], *(part for part in inside[1:] if part not in around)}
        found[module] = needed - {module}
    return found


def _with_parents(name: str) -> Iterator[str]:
    """``a.b.c``, ``a.b``, ``a``."""
    while name:
        yield name
        name = name.rpartition(".")[0]


# --- the parts ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """One box of the picture.

    Attributes
    ----------
    title : str
    row, column : float
        Where it stands. A part imports only parts of rows below its own.
    modules : tuple of str
        Modules and packages, with all that they hold; the longest name that fits decides.
    kind : str
        A key of `KINDS`; decides the colour.
    line : str
        What it holds; default: the first line of its module's docstring.
    """

    title: str
    row: int
    column: float
    modules: tuple[str, ...]
    kind: str
    line: str = ""

    def __post_init__(self) -> None:
        if not self.line:
            object.__setattr__(self, "line", _first_line(self.modules[0]))


def _first_line(module: str) -> str:
    files = files_of()[module]
    text = ast.get_docstring(ast.parse(files[0].read_text(encoding="utf-8"))) or ""
    return text.split("\n\n")[0].replace("\n", " ").replace("`", "")


PARTS = (
    Part("dcreg.cli", 0, 1.5, ("dcreg.cli", "dcreg.__main__"), "use"),
    Part(
        "dcreg: register, sweep, …", 1, 1.5,
        (
            "dcreg", "dcreg.driver.solve", "dcreg.driver.matching", "dcreg.driver.downsample", "dcreg.driver.sweep",
            "dcreg.driver.sweep_level", "dcreg.driver.warm_up",
        ),
        "use",
        "The public names, and how a problem passes through the parts below.",
    ),
    Part("dcreg.modes", 2, 0, ("dcreg.modes",), "solve"),
    Part("dcreg.matches", 2, 1, ("dcreg.matches",), "solve"),
    Part("dcreg.plot", 2, 2, ("dcreg.plot",), "data"),
    Part("dcreg.io", 2, 3, ("dcreg.io",), "data"),
    Part("dcreg.families.dc.registry", 3, 0.5, ("dcreg.families.dc.registry",), "solve"),
    Part(
        "results", 3, 2, ("dcreg.result", "dcreg.runner_up", "dcreg.sweep_result", "dcreg.diagnostics"), "data",
        "What register and sweep return: it prints and writes itself.",
    ),
    Part("dcreg.spaces", 4, 0.5, ("dcreg.spaces",), "solve"),
    Part("dcreg.certificate.record", 4, 2, ("dcreg.certificate.record",), "prove"),
    Part("dcreg.local", 5, 0.5, ("dcreg.local",), "solve"),
    Part("dcreg.search", 6, 0.5, ("dcreg.search",), "solve"),
    Part("dcreg.certificate", 6, 2, ("dcreg.certificate",), "prove"),
    Part("dcreg.problem", 6, 3, ("dcreg.problem",), "data"),
    Part("dcreg.kernels", 7, 0.5, ("dcreg.kernels",), "solve"),
    Part(
        "status, names, files, text", 7, 2,
        ("dcreg.status", "dcreg.names", "dcreg.files", "dcreg.text", "dcreg._version"), "base",
        "What every part may use.",
    ),
)  # fmt: skip


def part_of(module: str) -> Part:
    """The part that a module belongs to.

    Raises
    ------
    LookupError
        For a module at the top of the library that `PARTS` does not mention.
    """
    owners = {name: part for part in PARTS for name in part.modules}
    for name in _with_parents(module):
        # the library's own name stands for its __init__ alone
        if name in owners and (name != LIBRARY or module == LIBRARY):
            return owners[name]
    raise LookupError(f"{module} belongs to no part; name it in PARTS of docs/architecture.py")


def arrows(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """Which parts every part imports, by title."""
    found: dict[str, set[str]] = {part.title: set() for part in PARTS}
    for module, needed in imports.items():
        owner = part_of(module).title
        found[owner] |= {part_of(name).title for name in needed} - {owner}
    return found


def reduced(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The graph without the arrows that a chain of other arrows implies; it must have no cycles."""

    def below(name: str) -> set[str]:
        return graph[name].union(*(below(other) for other in graph[name]))

    return {
        name: needed - set().union(*(below(other) for other in needed))
        for name, needed in graph.items()
    }


# --- the picture ----------------------------------------------------------------------------------

COLUMN, ROW = 272, 136  # from box to box
WIDTH, HEIGHT = 244, 84  # of a box
MARGIN = 28  # around the picture
LANE = 14  # between arrows that pass a row of boxes side by side
PORT = 44  # between arrows at the same edge of a box
CAPTION = 'Arrows mean "imports"; those that follow from a chain of others are left out.'
KINDS = {
    "use": "entry",
    "solve": "solving",
    "prove": "proof",
    "data": "data in and out",
    "base": "shared",
}

STYLE = """
  text { font-family: system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif; fill: #1f2933 }
  .title { font-size: 14px; font-weight: 600 }
  .line { font-size: 11.5px; fill: #4a5663 }
  .page { fill: #ffffff }
  .box { stroke-width: 1.2 }
  .use { fill: #eef1f5; stroke: #8896a5 }
  .solve { fill: #e6f0fb; stroke: #5b93cf }
  .prove { fill: #e7f5ec; stroke: #56a477 }
  .data { fill: #fdf2e2; stroke: #d59f4f }
  .base { fill: #f3eefa; stroke: #9a7fc4 }
  .arrow { fill: none; stroke: #7b8794; stroke-width: 1.3 }
  .head { fill: #7b8794 }
  @media (prefers-color-scheme: dark) {
    text { fill: #e8edf2 }
    .line { fill: #b4bfca }
    .page { fill: #14181d }
    .use { fill: #262c34; stroke: #77828f }
    .solve { fill: #16293d; stroke: #4f86c0 }
    .prove { fill: #17301f; stroke: #4c946a }
    .data { fill: #36291a; stroke: #b5843d }
    .base { fill: #2a2338; stroke: #8a70b3 }
    .arrow { stroke: #8894a1 }
    .head { fill: #8894a1 }
  }
"""


def _left(part: Part) -> float:
    return MARGIN + part.column * COLUMN


def _centre(part: Part) -> float:
    return _left(part) + 0.5 * WIDTH


def _top(row: int) -> float:
    return MARGIN + row * ROW


@dataclass
class Arrow:
    """From one part down to another.

    Attributes
    ----------
    start, end : Part
    lanes : list of float
        Where it passes the rows of boxes between the two, from top to bottom.
    leaves, enters : float
        Where it stands on the edges of the two.
    """

    start: Part
    end: Part
    lanes: list[float]
    leaves: float = 0.0
    enters: float = 0.0

    def path(self) -> str:
        """A curve that turns in the gaps between rows and is vertical elsewhere."""
        x, y = self.leaves, _top(self.start.row) + HEIGHT
        out = f"M{x:g} {y:g}"
        for row, to in enumerate([*self.lanes, self.enters], self.start.row + 1):
            is_last = row == self.end.row
            bottom = _top(row) - 6 * is_last  # the arrow's head follows
            middle = 0.5 * (y + bottom)
            out += f" C{x:g} {middle:g} {to:g} {middle:g} {to:g} {bottom:g}"
            x, y = to, _top(row) + HEIGHT
            out += "" if is_last else f" V{y:g}"
        return out


def placed(graph: dict[str, set[str]]) -> list[Arrow]:
    """The arrows of a graph, side by side at the boxes they join, and clear of those they pass."""
    by_title = {part.title: part for part in PARTS}
    found = [
        Arrow(part, by_title[title], []) for part in PARTS for title in sorted(graph[part.title])
    ]
    taken: dict[int, list[float]] = {part.row: [] for part in PARTS}
    for arrow in sorted(found, key=lambda arrow: arrow.end.row - arrow.start.row):
        rows = range(arrow.start.row + 1, arrow.end.row)
        for row in rows:
            share = (row - arrow.start.row) / (len(rows) + 1)
            wish = (1 - share) * _centre(arrow.start) + share * _centre(arrow.end)
            arrow.lanes.append(_lane(row, wish, taken[row]))
            taken[row].append(arrow.lanes[-1])
    for part in PARTS:
        down = [arrow for arrow in found if arrow.start is part]
        down.sort(key=lambda arrow: [*arrow.lanes, _centre(arrow.end)])
        for at, arrow in enumerate(down):
            arrow.leaves = _centre(part) + PORT * (at - 0.5 * (len(down) - 1))
        up = [arrow for arrow in found if arrow.end is part]
        up.sort(key=lambda arrow: [*arrow.lanes[::-1], _centre(arrow.start)])
        for at, arrow in enumerate(up):
            arrow.enters = _centre(part) + PORT * (at - 0.5 * (len(up) - 1))
    return found


def _lane(row: int, wish: float, taken: list[float]) -> float:
    """The place nearest to `wish` where an arrow can pass a row."""
    boxes = [_left(part) for part in PARTS if part.row == row]
    free = [
        x
        for x in range(MARGIN, MARGIN + 4 * COLUMN)
        if all(not left - LANE < x < left + WIDTH + LANE for left in boxes)
        and all(abs(x - other) >= LANE for other in taken)
    ]
    return float(min(free, key=lambda x: (abs(x - wish), x)))


def draw(graph: dict[str, set[str]]) -> str:
    """The picture as SVG, light or dark as the page's reader prefers."""
    width = 2 * MARGIN + 3 * COLUMN + WIDTH
    bottom = _top(max(part.row for part in PARTS)) + HEIGHT
    height = bottom + 52
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" role="img">',
        "<title>Parts of the library and what they import</title>",
        f"<style>{STYLE}</style>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="2" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path class="head" d="M0 0 L8 4 L0 8 z"/></marker></defs>',
        f'<rect class="page" width="{width}" height="{height}" rx="10"/>',
    ]
    for arrow in placed(graph):
        out.append(
            f'<path class="arrow" marker-end="url(#head)" data-from="{escape(arrow.start.title)}" '
            f'data-to="{escape(arrow.end.title)}" d="{arrow.path()}"/>'
        )
    for part in PARTS:
        out += _box(part)
    return "\n".join([*out, *_legend(bottom + 34), "</svg>", ""])


def _box(part: Part) -> list[str]:
    left, top = _left(part), _top(part.row)
    lines = textwrap.wrap(part.line, 35, max_lines=3, placeholder=" …")
    first = top + 0.5 * (HEIGHT - 15 * len(lines)) + 4
    texts = [("title", part.title, first)]
    texts += [("line", line, first + 18 + 15 * at) for at, line in enumerate(lines)]
    return [
        f'<g data-part="{escape(part.title)}" data-top="{top:g}">',
        f'<rect class="box {part.kind}" x="{left:g}" y="{top:g}" width="{WIDTH}" '
        f'height="{HEIGHT}" rx="8"/>',
        *(f'<text class="{kind}" x="{left + 14:g}" y="{y:g}">{escape(text)}</text>'
          for kind, text, y in texts),
        "</g>",
    ]  # fmt: skip


def _legend(y: float) -> list[str]:
    """What arrows and colours mean."""
    out, x = [f'<text class="line" x="{MARGIN}" y="{y:g}">{escape(CAPTION)}</text>'], 560.0
    for kind, meaning in KINDS.items():
        out.append(
            f'<rect class="box {kind}" x="{x:g}" y="{y - 10:g}" width="13" height="13" rx="3"/>'
        )
        out.append(f'<text class="line" x="{x + 19:g}" y="{y:g}">{meaning}</text>')
        x += 46 + 6.2 * len(meaning)
    return out


if __name__ == "__main__":
    PICTURE.write_text(draw(reduced(arrows(read_imports()))), encoding="utf-8")
    print(f"wrote {PICTURE}")
