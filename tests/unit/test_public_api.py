"""What `dcreg` offers by name: complete, documented, and loaded only when it is used."""

import ast
import doctest
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
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
# What a small registration does without: other libraries, and parts of SciPy and of this one.
NOT_FOR_A_SOLVE = {
    "jinja2", "matplotlib", "open3d", "pandas", "plotly", "pooch", "psutil", "seaborn", "skimage",
    "sklearn", "snakemake", "scipy.optimize", "scipy.stats",
    "dcreg.certificate.verification", "dcreg.driver.matching", "dcreg.plot",
}  # fmt: skip
# Maximum number of modules that a command loads: of this library, and in total. A tenth more than when
# it was set; each module and each kernel in it delays the start.
HELP_MODULES = (14, 364)
SOLVE_MODULES = {
    "similarity2d": (134, 1125), "rigid3d": (122, 1110), "similarity3d": (124, 1117),
}  # fmt: skip


def python(code: str, *arguments: str) -> subprocess.CompletedProcess:
    """Run `code` in a fresh interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=PACKAGE.parent
    )


def modules_of(code: str) -> set[str]:
    """All modules that a fresh interpreter has loaded after running `code`."""
    finished = python(code + "\nimport sys; print(*sys.modules, file=sys.stderr)")
    assert finished.returncode == 0, finished.stderr
    return set(finished.stderr.split())


def loaded_by(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after running `code`."""
    return {name.partition(".")[0] for name in modules_of(code)}


def assert_few(modules: set[str], own: int, total: int) -> None:
    """Fail if more modules than before delay the start; Numba loads Coverage where it is installed."""
    named = {name for name in modules if name.partition(".")[0] == "dcreg"}
    assert len(named) <= own, sorted(named)
    counted = {name for name in modules if name.partition(".")[0] != "coverage"}
    assert len(counted) <= total, sorted(counted)


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


def test_help_loads_few_modules():
    assert_few(modules_of(command("--help")), *HELP_MODULES)


@pytest.mark.parametrize("model", names.MODEL_DIM)
def test_a_small_registration_loads_few_modules(model, tmp_path):
    rng = np.random.default_rng(0)
    points = rng.standard_normal((12, names.MODEL_DIM[model]))
    moved = points + 0.01 * rng.standard_normal(points.shape)
    files = [str(tmp_path / name) for name in ("a.npy", "b.npy")]
    for file, cloud in zip(files, (points, moved), strict=True):
        np.save(file, cloud)
    dcreg.register(points, moved, n_inliers=0.8, model=model)  # compiling would load more modules
    loaded = modules_of(
        command("register", *files, "--model", model, "--n-inliers", "0.8", "--quiet")
    )
    assert not loaded & NOT_FOR_A_SOLVE
    if model == "similarity2d":
        assert not loaded & {"scipy.sparse", "scipy.spatial"}
    else:
        assert not [name for name in loaded if name.startswith("dcreg.families.matches")]
    assert_few(loaded, *SOLVE_MODULES[model])


@pytest.mark.parametrize(("given", "used"), [(None, "4"), ("20", "20")])
def test_idle_threads_of_openblas_sleep_at_once_unless_the_user_decides(given, used, monkeypatch):
    monkeypatch.delenv("OPENBLAS_THREAD_TIMEOUT", raising=False)
    if given is not None:
        monkeypatch.setenv("OPENBLAS_THREAD_TIMEOUT", given)
    shown = "\nimport os; print(os.environ['OPENBLAS_THREAD_TIMEOUT'])"
    assert python(command("--version") + shown).stdout.split()[-1] == used


@pytest.mark.parametrize("package", ["typer", "rich"])
def test_a_missing_package_of_the_command_line_is_named(package):
    code = f"import sys; sys.modules['{package}'] = None; from dcreg.cli import main; main()"
    finished = python(code, "--help")
    assert finished.returncode == 1
    assert f"needs the package {package}" in finished.stderr
    assert "pip install typer rich\n" in finished.stderr
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
                assert node.module in (
                    "dcreg.names",
                    "dcreg.files",
                ) or f"{node.module}.".startswith("dcreg.cli.")
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
