"""Draw the packages of the library and their imports: ``python -m docs.architecture``.

The graph of imports is grimp's. The picture shows one box per package and at most one arrow between two
packages; an arrow that a chain of other arrows implies is left out. A test draws the picture again and
compares it with ``docs/architecture.svg``.
"""

from __future__ import annotations

import ast
import itertools
import textwrap
from html import escape
from pathlib import Path

import grimp
import networkx as nx

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "architecture.svg"

# Boxes of the picture that are not a folder of `dcreg`. All other single modules are "shared", or
# "families.protocol" if they lie in `families`.
GROUPS = {
    "cli": ("cli", "__main__"),
    "api": ("__init__", "api"),
    "results": ("result", "result_parts", "sweep_result", "diagnostics", "runner_up"),
}
LINES = {
    "cli": "The command line",
    "api": "Public functions and names",
    "questions": "Is a pose optimal, is it the only one?",
    "driver": "Normalise, start, search, polish, result",
    "io": "Readers and writers of clouds, pairs and pose graphs",
    "plot": "HTML pages and figures of results",
    "results": "Results, runner-up poses and warnings",
    "certificate": "Certificates and their verification",
    "families.protocol": "What every pose family provides",
    "families.dc": "Difference-of-convex bounds",
    "families.similarity2d": "Similarities in 2D",
    "families.translation3d": "Translations in norm space",
    "families.rotation3d": "Rotations about the origin",
    "families.rigid3d": "Rigid poses in 3D",
    "families.similarity3d": "Similarities in 3D",
    "families.matches": "Rigid poses over a list of matches",
    "assignment": "One-to-one matching and polish",
    "search": "Branch and bound, without geometry",
    "problem": "Checked and normalised problems",
    "jit": "Compiles kernels and keeps them on disk",
    "shared": "Names, statuses, files, text",
}


# --- the graph ------------------------------------------------------------------------------------


def package_of(module: str) -> str:
    """Return the box of the picture that a module belongs to, such as ``families.rigid3d``."""
    parts = module.split(".")[1:] or ["__init__"]
    name = ".".join(parts[: 2 if parts[0] == "families" else 1])
    for group, modules in GROUPS.items():
        if name in modules:
            return group
    if parts[0] != "families":
        return name if (ROOT / "dcreg" / name).is_dir() else "shared"
    is_family = len(parts) > 1 and (ROOT / "dcreg" / "families" / parts[1]).is_dir()
    return name if is_family else "families.protocol"


def package_graph() -> nx.DiGraph:
    """Return the imports between the packages of the library."""
    modules = grimp.build_graph("dcreg", cache_dir=None)
    graph: nx.DiGraph = nx.DiGraph()
    pairs = [
        (m, other)
        for m in modules.modules
        for other in modules.find_modules_directly_imported_by(m)
    ]
    stub = ast.parse((ROOT / "dcreg" / "__init__.pyi").read_text(encoding="utf-8"))
    for node in ast.walk(stub):  # public names that are loaded on first use
        if isinstance(node, ast.ImportFrom):
            names = [node.module] if node.module else [alias.name for alias in node.names]
            pairs += [("dcreg", f"dcreg.{name}") for name in names]
    graph.add_nodes_from(sorted({package_of(module) for module in modules.modules}))
    graph.add_edges_from(sorted({(package_of(a), package_of(b)) for a, b in pairs}))
    graph.remove_edges_from(list(nx.selfloop_edges(graph)))
    return graph


# --- the layout -----------------------------------------------------------------------------------

WIDTH, HEIGHT, GAP, ROW, MARGIN = 204, 70, 26, 116, 24


def place(arrows: nx.DiGraph) -> dict[object, tuple[float, int]]:
    """Return x and row of every box, and of every point where an arrow passes a row of boxes.

    The row of a box is the length of its longest chain of imports. Within the rows the boxes are
    ordered by the means of their neighbours, as in the method of Sugiyama.
    """
    rows: dict[object, int] = {}
    for row, names in enumerate(nx.topological_generations(arrows.reverse())):
        rows |= dict.fromkeys(names, row)
    links: nx.Graph = nx.Graph()
    links.add_nodes_from(arrows)
    for a, b in arrows.edges:
        nx.add_path(links, [a, *((a, b, row) for row in range(rows[a] - 1, rows[b], -1)), b])
    rows |= {node: node[2] for node in links if isinstance(node, tuple)}
    levels = [
        sorted((n for n in links if rows[n] == row), key=str)
        for row in range(max(rows.values()) + 1)
    ]

    x: dict[object, float] = {}
    for level in levels:
        _spread(level, dict.fromkeys(level, 0.0), x)
    for sweep in range(40):
        for row in range(len(levels)) if sweep % 2 else reversed(range(len(levels))):
            near = (row - 1, row + 1) if sweep > 30 else (row - 1,) if sweep % 2 else (row + 1,)
            wish = {}
            for node in levels[row]:
                seen = [x[other] for other in links[node] if rows[other] in near]
                wish[node] = sum(seen) / len(seen) if seen else x[node]
            levels[row].sort(key=lambda node: (wish[node], str(node)))
            _spread(levels[row], wish, x)
    left = min(x[node] - _width(node) / 2 for node in x) - MARGIN
    return {node: (round(x[node] - left, 1), rows[node]) for node in x}


def _width(node: object) -> float:
    return -GAP / 3 if isinstance(node, tuple) else WIDTH


def _spread(level: list, wish: dict, x: dict[object, float]) -> None:
    """Place the nodes of a row in their order, as near to their wishes as their widths allow."""
    blocks: list[list] = []  # [sum of wishes less offsets, count, nodes, offsets, length]
    for node in level:
        blocks.append([wish[node], 1, [node], [0.0]])
        while len(blocks) > 1:
            (sum_a, n_a, nodes_a, off_a), (sum_b, n_b, nodes_b, off_b) = blocks[-2:]
            step = off_a[-1] + (_width(nodes_a[-1]) + _width(nodes_b[0])) / 2 + GAP
            if sum_a / n_a + step <= sum_b / n_b:
                break
            merged = [sum_a + sum_b - n_b * step, n_a + n_b, nodes_a + nodes_b]
            blocks[-2:] = [[*merged, off_a + [step + off for off in off_b]]]
    for total, count, nodes, offsets in blocks:
        x.update({node: total / count + off for node, off in zip(nodes, offsets, strict=True)})


# --- the picture ----------------------------------------------------------------------------------

STYLE = """
  text { font-family: system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif; fill: #1f2933 }
  .title { font-size: 14px; font-weight: 600 }
  .line { font-size: 11.5px; fill: #4a5663 }
  .page { fill: #ffffff }
  .box { fill: #eef1f5; stroke: #8896a5; stroke-width: 1.2 }
  .family { fill: #e6f0fb; stroke: #5b93cf }
  .arrow { fill: none; stroke: #7b8794; stroke-width: 1.3 }
  .head { fill: #7b8794 }
  @media (prefers-color-scheme: dark) {
    text { fill: #e8edf2 }
    .line { fill: #b4bfca }
    .page { fill: #14181d }
    .box { fill: #262c34; stroke: #77828f }
    .family { fill: #16293d; stroke: #4f86c0 }
    .arrow { stroke: #8894a1 }
    .head { fill: #8894a1 }
  }
"""
CAPTION = "An arrow means “imports”. Arrows that follow from a chain of others are left out."


def draw(graph: nx.DiGraph) -> str:
    """Return the picture of an acyclic graph as SVG, for light and dark pages."""
    reduced = nx.transitive_reduction(graph)
    arrows = nx.DiGraph()  # in an order that does not depend on hashes
    arrows.add_nodes_from(sorted(reduced))
    arrows.add_edges_from(sorted(reduced.edges))
    places = place(arrows)
    top = max(row for _, row in places.values())
    spots = {node: (x, MARGIN + (top - row) * ROW) for node, (x, row) in places.items()}
    width = round(max(x + _width(node) / 2 for node, (x, _) in spots.items()) + MARGIN)
    bottom = MARGIN + top * ROW + HEIGHT
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {bottom + 40}" width="{width}" '
        f'height="{bottom + 40}" role="img">',
        "<title>Packages of the library and their imports</title>",
        f"<style>{STYLE}</style>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="2" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto"><path class="head" d="M0 0 L8 4 L0 8 z"/></marker></defs>',
        f'<rect class="page" width="{width}" height="{bottom + 40}" rx="10"/>',
    ]
    for a, b in arrows.edges:
        between = [spots[a, b, row] for row in range(places[a][1] - 1, places[b][1], -1)]
        path = _path(spots[a], between, spots[b])
        out.append(
            f'<path class="arrow" marker-end="url(#head)" data-from="{a}" data-to="{b}" d="{path}"/>'
        )
    for name in arrows:
        out += _box(name, *spots[name])
    out += [f'<text class="line" x="{MARGIN}" y="{bottom + 26}">{CAPTION}</text>', "</svg>", ""]
    return "\n".join(out)


def _path(start: tuple, between: list[tuple], end: tuple) -> str:
    """Return a curve that bends between the rows and is vertical where it passes one."""
    x, y = start[0], start[1] + HEIGHT
    out = f"M{x:g} {y:g}"
    for (to, below), is_last in itertools.chain(
        ((point, False) for point in between), [(end, True)]
    ):
        to_y = below - 6 * is_last  # the head of the arrow follows
        middle = (y + to_y) / 2
        out += f" C{x:g} {middle:g} {to:g} {middle:g} {to:g} {to_y:g}"
        out += "" if is_last else f" V{below + HEIGHT:g}"
        x, y = to, below + HEIGHT
    return out


def _box(name: str, x: float, y: float) -> list[str]:
    left = round(x - WIDTH / 2, 1)
    lines = textwrap.wrap(LINES.get(name, ""), 29, max_lines=2, placeholder=" …")
    texts = [("title", name, y + 21)]
    texts += [("line", line, y + 40 + 15 * at) for at, line in enumerate(lines)]
    kind = "box family" if name.startswith("families") else "box"
    return [
        f'<g data-package="{name}" data-top="{y:g}">',
        f'<rect class="{kind}" x="{left:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="8"/>',
        *(
            f'<text class="{c}" x="{left + 12:g}" y="{at:g}">{escape(t)}</text>'
            for c, t, at in texts
        ),
        "</g>",
    ]


if __name__ == "__main__":
    PICTURE.write_text(draw(package_graph()), encoding="utf-8")
    print(f"wrote {PICTURE}")
