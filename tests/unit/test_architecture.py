"""Rules of the folders that no single file shows: who may import whom, and what README promises."""

import ast
import re
import subprocess
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HARNESS = {"baselines", "data", "workflows", "reports"}
README = ROOT / "README.md"


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted((ROOT / "dcreg").rglob("*.py"))}


def at_module_level(tree: ast.AST):
    """Nodes that run on import, so without the bodies of functions and of ``if TYPE_CHECKING``."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        yield from at_module_level(node)


def imported_names(nodes, package: str) -> set[str]:
    """Dotted names of everything imported; ``from a import b`` gives ``a`` and ``a.b``."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


@cache
def imports(module: str, on_import_only: bool = False) -> frozenset[str]:
    path = MODULES[module]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    nodes = at_module_level(tree) if on_import_only else ast.walk(tree)
    return frozenset(imported_names(nodes, package))


def dependencies(module: str) -> set[str]:
    """Modules of the library that `module` needs before it can run.

    A package that is on the way to a module of its own is left out: importing ``dcreg.search``
    from ``dcreg/bounds/base.py`` does not make ``dcreg`` a dependency.
    """
    return {name for name in imports(module, True) if name in MODULES} - {module, "dcreg"}


def test_imports_are_seen_in_all_their_forms():
    source = "import a.b\nfrom c import d\nfrom . import e\nfrom ..f import g\n"
    late = "def late():\n    import h\nif TYPE_CHECKING:\n    import i\n"
    nested = "try:\n    import j\nfinally:\n    pass\n"
    tree = ast.parse(source + late + nested)
    everything = imported_names(ast.walk(tree), "dcreg.sub")
    assert {"a.b", "c.d", "dcreg.sub.e", "dcreg.f.g", "h", "i", "j"} <= everything
    first = imported_names(at_module_level(tree), "dcreg.sub")
    assert "j" in first
    assert not {"h", "i"} & first


def test_library_is_found():
    assert {"dcreg", "dcreg.search", "dcreg.registration", "dcreg.bounds.dc"} <= MODULES.keys()


@pytest.mark.parametrize("module", MODULES)
def test_library_never_imports_the_harness(module):
    assert not {name.split(".")[0] for name in imports(module)} & HARNESS


def test_search_knows_no_geometry():
    forbidden = ("dcreg.models", "dcreg.kernels", "dcreg.bounds")
    assert not [name for name in imports("dcreg.search") if name.startswith(forbidden)]


# The NumPy twin of the kernels, for tests, works on models.
KERNELS = [
    name
    for name in MODULES
    if name.startswith("dcreg.kernels") and name != "dcreg.kernels.reference"
]


@pytest.mark.parametrize("module", KERNELS)
def test_kernels_import_nothing_above_them(module):
    above = ("dcreg.bounds", "dcreg.models", "dcreg.search", "dcreg.registration", "dcreg.cli")
    assert not [name for name in imports(module) if name.startswith(above)]


def test_no_import_cycles():
    try:
        TopologicalSorter({module: dependencies(module) for module in MODULES}).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


# --- README, Makefile, lock file ---------------------------------------------------------------


def declared_targets() -> set[str]:
    """Phony targets of the Makefile: what a person may call."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    return {name for line in re.findall(r"^\.PHONY:(.*)$", text, re.M) for name in line.split()}


def helped_targets() -> set[str]:
    shown = subprocess.run(
        ["make", "--no-print-directory", "help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(re.findall(r"^\s*make ([a-z0-9-]+)", shown.stdout, re.M))


def named_targets() -> set[str]:
    """Targets in the code of README: `make x` in a code span, or at a line's start in a block."""
    text = README.read_text(encoding="utf-8")
    code = re.findall(r"^(?: {4}|\s*[$] )?make ([a-z0-9-]+)", text, re.M)
    return {*code, *re.findall(r"`(?:[A-Z_]+=\S+ )*make ([a-z0-9-]+)", text)}


def test_readme_names_only_targets_that_exist():
    assert named_targets() <= declared_targets()


def test_readme_and_make_help_name_the_same_targets():
    assert named_targets() == helped_targets()


@pytest.mark.parametrize("command", ["make demo", "make test"])
def test_readme_shows_the_two_commands(command):
    """In a block near the top, where somebody new looks first."""
    blocks = re.findall(r"^```.*?^```", README.read_text(encoding="utf-8"), re.M | re.S)
    assert any(command in block for block in blocks[:1])


def test_readme_names_only_paths_that_exist():
    text = README.read_text(encoding="utf-8")
    paths = re.findall(r"`((?:dcreg|baselines|data|workflows|reports|tests)/[\w./-]*)`", text)
    assert len(paths) > 10
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_lock_file_pins_versions_and_names_no_host():
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    packages = [line for line in lines if line.strip() and not line.startswith("#")]
    assert len(packages) > 20
    assert not [line for line in lines if "://" in line or "index" in line or " @ " in line]
    assert not [line for line in packages if not re.match(r"^[A-Za-z0-9._\[\]-]+==\S+", line)]
