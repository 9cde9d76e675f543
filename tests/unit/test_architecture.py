"""Rules that no single file shows: who may import whom, and how large modules and functions may be."""

import ast
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import grimp
import networkx as nx
import pytest

from docs import architecture

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "dcreg").rglob("*.py"))


# --- who may import whom -----------------------------------------------------------------------


def test_import_contracts_are_kept():
    """The contracts of pyproject.toml: layers, no cycle, and parts that must not know each other."""
    checked = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=ROOT, capture_output=True, text=True, env={"PYTHONPATH": str(ROOT), "PATH": ""},
    )  # fmt: skip
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_library_imports_only_the_packages_that_it_requires():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    required = [*project["dependencies"], *project["optional-dependencies"]["plot"]]
    known = {re.match(r"[\w-]+", line).group().replace("-", "_") for line in required}
    known |= {"llvmlite", "matplotlib", "seaborn"}  # of Numba; pictures for print, if installed
    graph = grimp.build_graph("dcreg", include_external_packages=True, cache_dir=None)
    external = {name for name in graph.modules if graph.is_module_squashed(name)}
    assert external - sys.stdlib_module_names <= known


# --- the picture -------------------------------------------------------------------------------


@cache
def graph() -> nx.DiGraph:
    return architecture.package_graph()


def test_packages_import_each_other_in_one_direction():
    assert not list(nx.simple_cycles(graph()))
    assert {"api", "driver", "search", "families.rigid3d", "shared"} <= set(graph())


def test_every_package_has_a_line_in_the_picture():
    assert set(graph()) == set(architecture.LINES)


def test_picture_is_current():
    drawn = architecture.draw(graph())
    assert architecture.PICTURE.read_text("utf-8") == drawn, "run: python -m docs.architecture"


def test_every_arrow_of_the_picture_points_down():
    tree = ET.parse(architecture.PICTURE)
    boxes = tree.iterfind(".//*[@data-package]")
    top = {box.get("data-package"): float(box.get("data-top")) for box in boxes}
    arrows = [
        (line.get("data-from"), line.get("data-to")) for line in tree.iterfind(".//*[@data-from]")
    ]
    assert len(arrows) == len(set(arrows)) >= len(top) - 1
    assert not [(a, b) for a, b in arrows if top[a] >= top[b]]


# --- sizes -------------------------------------------------------------------------------------

MODULE_LINES, FUNCTION_LINES, PARAMETERS = 400, 80, 8
LARGE = {
    "api.register": "the public function: every setting by name, and its documentation",
    "api.register_matches": "as register",
    "api.sweep": "as register",
    "questions.alternatives.alternatives": "as register",
    "questions.certify.certify": "as register",
    "questions.inliers.max_inliers": "as register",
}


def functions(name: str, tree: ast.AST):
    """Dotted name and syntax tree of every function of a module, also of nested ones."""
    for child in ast.iter_child_nodes(tree):
        is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        is_named = is_function or isinstance(child, ast.ClassDef)
        inner = f"{name}.{child.name}" if is_named else name
        if is_function:
            yield inner, child
        yield from functions(inner, child)


def size(function: ast.FunctionDef) -> tuple[int, int]:
    """Lines, docstring included, and parameters without ``self`` and ``cls``."""
    given = function.args
    names = [arg.arg for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [arg.arg for arg in (given.vararg, given.kwarg) if arg is not None]
    count = len(names) - (names[:1] in (["self"], ["cls"]))
    return function.end_lineno - function.lineno + 1, count


@cache
def large(path: Path) -> dict[str, tuple[int, int]]:
    """Functions of a file that exceed a limit, with their lines and parameters."""
    parts = path.relative_to(ROOT / "dcreg").with_suffix("").parts
    sizes = {
        name: size(node)
        for name, node in functions(".".join(parts), ast.parse(path.read_text(encoding="utf-8")))
    }
    return {n: s for n, s in sizes.items() if s[0] > FUNCTION_LINES or s[1] > PARAMETERS}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_modules_and_functions_stay_small(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MODULE_LINES
    assert not large(path).keys() - LARGE.keys(), large(path)


def test_exceptions_from_the_sizes_are_needed():
    assert set().union(*(large(path) for path in FILES)) >= LARGE.keys()


def test_sizes_are_measured():
    tree = ast.parse(
        "class A:\n    def f(self, a, /, b, *c, d, **e):\n        pass\n\n\ndef g():\n  0"
    )
    assert {name: size(node) for name, node in functions("m", tree)} == {
        "m.A.f": (2, 5),
        "m.g": (2, 0),
    }
