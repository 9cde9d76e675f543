"""Rules that no single file shows: who may import whom, and how large things may be."""

import ast
import re
import sys
import xml.etree.ElementTree as ET
from fnmatch import fnmatchcase
from functools import cache
from graphlib import CycleError, TopologicalSorter

import pytest

from docs import architecture
from docs.architecture import PARTS, PICTURE, part_of, read_imports

FILES = architecture.files_of()
# Module of the library -> modules of it that its imports load, also those within functions and those
# for type checkers only.
IMPORTS = read_imports()


def lies_in(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


@cache
def outside(module: str) -> frozenset[str]:
    """Packages beyond the library and Python itself that a module imports."""
    names = {name.split(".")[0] for name in architecture.names_imported_by(module, FILES)}
    return frozenset(names - sys.stdlib_module_names - {"dcreg", ""})


def reached(module: str) -> set[str]:
    """The modules that are loaded with a module; the library's own ``__init__`` loads none."""
    seen, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += IMPORTS[name]
    return seen


# --- who may import whom -----------------------------------------------------------------------

# Package -> patterns of what it may import of the library beside itself. The others are bound by the
# rows of the picture alone.
MAY_IMPORT = {
    "dcreg.kernels": (),
    "dcreg.problem": ("dcreg.names",),
    "dcreg.io": ("dcreg.problem",),
    # no geometry: of the kernels only the heap
    "dcreg.search": ("dcreg.kernels", "dcreg.search.kernels", "dcreg.status", "dcreg.files"),
    "dcreg.local": ("dcreg.search", "dcreg.kernels*"),
    "dcreg.spaces": ("dcreg.search*", "dcreg.kernels*", "dcreg.problem*", "dcreg.local*"),
    # whatever the command line does is done by public names
    "dcreg.cli": ("dcreg", "dcreg.names"),
}

# Package -> the part of the library that uses it; all else is Python, NumPy and SciPy.
USERS = {
    "numba": "dcreg.kernels",
    "llvmlite": "dcreg.kernels",
    "lazy_loader": "dcreg",
    "orjson": "dcreg.files",
    "typer": "dcreg.cli",
    "rich": "dcreg.cli",
    "plotly": "dcreg.plot",
    "matplotlib": "dcreg.plot",
    "seaborn": "dcreg.plot",
}

# All that verification is made of: nothing that takes part in a search.
VERIFICATION = {
    "dcreg.certificate",
    "dcreg.certificate.cover",
    "dcreg.certificate.families",
    "dcreg.certificate.format",
    "dcreg.certificate.line",
    "dcreg.certificate.prices",
    "dcreg.certificate.proof",
    "dcreg.certificate.verification",
    "dcreg.files",
    "dcreg._version",
}


def test_imports_are_seen_in_all_their_forms():
    source = "import a.b\nfrom c import d\nfrom . import e\nfrom ..f import g\n"
    late = "def late():\n    import h\nif TYPE_CHECKING:\n    import i\n"
    nested = "try:\n    import j\nfinally:\n    pass\n"
    names = architecture.imported_names(ast.parse(source + late + nested), "dcreg.sub")
    assert names == {"a.b", "c.d", "dcreg.sub.e", "dcreg.f.g", "h", "i", "j"}


def test_imports_of_the_library_are_found():
    assert "dcreg.search" in IMPORTS["dcreg.families.protocol"]
    assert "dcreg.search.kernels" in IMPORTS["dcreg.search.boxes"]
    assert "dcreg.driver.solve" in IMPORTS["dcreg"]  # listed in the stub, loaded late
    assert "dcreg" in IMPORTS["dcreg.cli.register"]
    assert "dcreg.certificate" not in IMPORTS["dcreg.certificate.record"]  # lies within it


@pytest.mark.parametrize("module", FILES)
def test_library_uses_a_package_only_where_it_belongs(module):
    """So it never imports the harness, and reading a result needs neither command line nor figures."""
    allowed = [package for package, user in USERS.items() if part_of(module) is part_of(user)]
    assert outside(module) <= {"numpy", "scipy", *allowed}


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_package_imports_only_what_it_may(package):
    inside = {name for name in FILES if lies_in(name, package)}
    assert inside
    foreign = set().union(*(IMPORTS[name] for name in inside)) - inside
    patterns = MAY_IMPORT[package]
    assert not [
        name for name in foreign if not any(fnmatchcase(name, pattern) for pattern in patterns)
    ]


def test_verification_loads_nothing_of_the_search():
    assert reached("dcreg.certificate.verification") == VERIFICATION - {"dcreg.certificate"}
    assert reached("dcreg.certificate") == VERIFICATION


def test_no_import_cycles():
    """Neither for type checkers nor through packages that hand names on."""
    fail_at_cycle(IMPORTS)


@pytest.mark.parametrize("package", ["baselines", "data", "workflows", "reports"])
def test_no_import_cycles_in_the_harness(package):
    imports = read_imports(package)
    assert len(imports) > 1
    fail_at_cycle(imports)


def fail_at_cycle(imports: dict[str, set[str]]) -> None:
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_a_cycle_would_be_found(tmp_path, monkeypatch):
    package = tmp_path / "lib"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "a.py").write_text("from lib import b\n")
    (package / "b.py").write_text("if TYPE_CHECKING:\n    from lib.a import x\n")
    monkeypatch.setattr(architecture, "HERE", tmp_path / "docs")
    imports = read_imports("lib")
    assert imports == {"lib": set(), "lib.a": {"lib.b"}, "lib.b": {"lib.a"}}
    with pytest.raises(CycleError):
        TopologicalSorter(imports).prepare()


# --- the picture -------------------------------------------------------------------------------


@pytest.mark.parametrize("module", FILES)
def test_module_imports_only_parts_below_its_own(module):
    own = part_of(module)
    wrong = {
        name for name in IMPORTS[module] if part_of(name) != own and part_of(name).row <= own.row
    }
    assert not wrong


def test_every_module_stands_in_the_picture():
    named = {name for part in PARTS for name in part.modules}
    assert named <= FILES.keys()
    with pytest.raises(LookupError, match=r"newcomer belongs to no part"):
        part_of("dcreg.newcomer")


def test_picture_shows_the_imports_of_today():
    drawn = architecture.draw(architecture.reduced(architecture.arrows(IMPORTS)))
    assert PICTURE.read_text(encoding="utf-8") == drawn, "run: python docs/architecture.py"


def test_every_arrow_of_the_picture_points_downwards():
    tree = ET.parse(PICTURE)
    top = {
        box.get("data-part"): float(box.get("data-top"))
        for box in tree.iterfind(".//*[@data-part]")
    }
    assert len(top) == len(PARTS)
    lines = list(tree.iterfind(".//*[@data-from]"))
    assert len(lines) >= len(PARTS) - 1
    for line in lines:
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", line.get("d"))]
        assert top[line.get("data-from")] < top[line.get("data-to")]
        assert numbers[1] < numbers[-1]


def test_chains_make_arrows_superfluous():
    graph = {"a": {"b", "c", "d"}, "b": {"c"}, "c": set(), "d": set()}
    assert architecture.reduced(graph) == {"a": {"b", "d"}, "b": {"c"}, "c": set(), "d": set()}


# --- sizes -------------------------------------------------------------------------------------

MODULE_LINES, FUNCTION_LINES, PARAMETERS = 400, 80, 8
OPTIONS = "its parameters are the options of a command, each documented where it is declared"
LARGE = {
    "dcreg.driver.solve.register": "the public function: every setting by name, and its manual",
    "dcreg.driver.matching.register_matches": "as register",
    "dcreg.driver.sweep.sweep": "as register",
    "dcreg.cli.register.register": OPTIONS,
    "dcreg.cli.matches.register_matches": OPTIONS,
    "dcreg.cli.sweep.sweep": OPTIONS,
}


def functions(module: str):
    """Dotted name and syntax tree of every function, also of those within others."""
    waiting = [
        (module, ast.parse(path.read_text(encoding="utf-8")))
        for path in FILES[module]
        if path.suffix == ".py"
    ]
    while waiting:
        name, node = waiting.pop()
        for child in ast.iter_child_nodes(node):
            is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            inner = (
                f"{name}.{child.name}" if is_function or isinstance(child, ast.ClassDef) else name
            )
            if is_function:
                yield inner, child
            waiting.append((inner, child))


def size(function: ast.FunctionDef) -> tuple[int, int]:
    """Lines, docstring included, and parameters without ``self`` and ``cls``."""
    given = function.args
    names = [arg.arg for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [arg.arg for arg in (given.vararg, given.kwarg) if arg is not None]
    count = len(names) - (names[:1] in (["self"], ["cls"]))
    return function.end_lineno - function.lineno + 1, count


def is_large(function: ast.FunctionDef) -> bool:
    lines, count = size(function)
    return lines > FUNCTION_LINES or count > PARAMETERS


@pytest.mark.parametrize("module", FILES)
def test_modules_and_functions_stay_small(module):
    for path in FILES[module]:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= MODULE_LINES
    large = {name: size(node) for name, node in functions(module) if is_large(node)}
    assert not large.keys() - LARGE.keys(), large


def test_exceptions_from_the_sizes_are_needed():
    large = {name for module in FILES for name, node in functions(module) if is_large(node)}
    assert LARGE.keys() <= large


def test_sizes_are_measured():
    tree = ast.parse(
        "class A:\n    def f(self, a, /, b, *c, d, **e):\n        pass\n\n\ndef g():\n  0"
    )
    f, g = tree.body[0].body[0], tree.body[1]
    assert size(f) == (2, 5)
    assert size(g) == (2, 0)
