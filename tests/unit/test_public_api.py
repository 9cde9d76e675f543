"""What `dcreg` offers by name: complete, documented, and loaded only when it is used."""

import ast
import doctest
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import dcreg
from dcreg import names
from dcreg.families.mode import all_modes
from dcreg.families.registry import bounds_of
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.io import READERS

PACKAGE = Path(dcreg.__file__).parent
HEAVY = {"numpy", "scipy", "numba", "plotly", "matplotlib"}


def python(code: str, *arguments: str) -> subprocess.CompletedProcess:
    """Run `code` in a fresh interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=PACKAGE.parent
    )


def loaded_by(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after running `code`."""
    code += "\nimport sys; print(*{name.split('.')[0] for name in sys.modules}, file=sys.stderr)"
    finished = python(code)
    assert finished.returncode == 0, finished.stderr
    return set(finished.stderr.split())


def command(*arguments: str) -> str:
    return (
        "import sys\n"
        f"sys.argv = ['dcreg', *{arguments!r}]\n"
        "from dcreg.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code, end.code"
    )


@pytest.mark.parametrize(
    ("code", "not_needed"),
    [
        ("import dcreg; dcreg.__version__; dir(dcreg)", HEAVY),
        ("import dcreg; dcreg.bound_names(); dcreg.mode_names('rigid3d')", HEAVY),
        (command("--version"), HEAVY | {"rich"}),
        (command("--help"), HEAVY),
        (command("register", "--help"), HEAVY),
        (command("sweep", "--help"), HEAVY),
    ],
)
def test_names_versions_and_help_load_nothing_heavy(code, not_needed):
    assert not loaded_by(code) & not_needed


def test_solving_needs_neither_command_line_nor_figures():
    code = (
        "import numpy, dcreg\n"
        "p = numpy.random.default_rng(0).random((5, 2))\n"
        "print(dcreg.register(p, p, n_inliers=5, model='similarity2d'))"
    )
    assert not loaded_by(code) & {"typer", "rich", "plotly", "matplotlib", "pandas"}


@pytest.mark.parametrize("package", ["typer", "rich"])
def test_a_missing_package_of_the_command_line_is_named(package):
    code = f"import sys; sys.modules['{package}'] = None; from dcreg.cli import main; main()"
    finished = python(code, "--help")
    assert finished.returncode == 1
    assert f"needs the package {package}" in finished.stderr
    assert "pip install typer rich plotly" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_missing_plotly_is_named():
    code = "import sys; sys.modules['plotly'] = None; import dcreg; dcreg.plot_registration"
    finished = python(code)
    assert finished.stderr.endswith(
        "ModuleNotFoundError: figures need plotly, which is not installed; install it with: "
        "pip install plotly\n"
    )


def test_public_names_are_those_of_the_stub():
    """What type checkers see is what there is at run time."""
    tree = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imported = {
        alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    (stated,) = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))
    assert stated == sorted(stated)
    assert set(stated) == imported == set(dcreg.__all__)
    assert (PACKAGE / "py.typed").exists()


@pytest.mark.parametrize("name", dcreg.__all__)
def test_public_names_are_documented(name):
    public = getattr(dcreg, name)
    if inspect.isclass(public) or inspect.isfunction(public):
        assert inspect.getdoc(public)
        assert "dcreg" in public.__module__


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="registre"):
        dcreg.registre  # noqa: B018


def test_the_command_line_uses_public_names_only():
    """So all that it does can be done from Python."""
    used = set()
    for path in (PACKAGE / "cli").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dcreg"):
                assert node.module == "dcreg.names" or f"{node.module}.".startswith("dcreg.cli.")
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "dcreg":
                used.add(node.attr)
    assert used - {"__version__"} <= set(dcreg.__all__)
    assert {"register", "sweep", "verify", "plot_registration"} <= used


# --- names against the code that they select --------------------------------------------------------


def test_names_of_bounds_are_those_of_the_table():
    assert set(bounds_of(Similarity2D)) == set(names.BOUND_NAMES)
    assert set(bounds_of(Translation3D)) == set(names.BOUND_NAMES)
    assert names.DEFAULT_BOUND in bounds_of(Translation3D)


@pytest.mark.parametrize("model", names.MODEL_DIM)
def test_names_of_modes_are_those_of_the_table(model):
    assert [mode.name for mode in all_modes() if mode.model == model] == names.mode_names(model)


def test_formats_of_the_command_line_are_those_of_the_readers():
    from dcreg.cli.commands import register

    assert f"Files: {' '.join(READERS)}." in register.__doc__
    assert f"A ``{' '.join(READERS)}`` file" in dcreg.read_points.__doc__


# --- examples ---------------------------------------------------------------------------------------

EXAMPLES = [path for path in sorted(PACKAGE.rglob("*.py")) if ">>> " in path.read_text("utf-8")]


def test_the_main_functions_have_examples():
    assert all(">>> " in each.__doc__ for each in (dcreg.register, dcreg.sweep, dcreg.verify))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_of_docstrings_hold(path):
    module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted
    assert not found.failed
