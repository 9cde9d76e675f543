"""The cache of compiled kernels: what is compiled when, and that machine code fits its sources."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dcreg
from dcreg.driver.warm_up import _works
from dcreg.families.registry import bound_parts
from dcreg.names import BOUND_NAMES, DEFAULT_BOUND, MODEL_DIM

LIBRARY = Path(dcreg.__file__).parent
SUM = "from dcreg.assignment.kernels.selection import total\nimport numpy as np\n"
SUM += "print(total(np.ones(4)))"


def run(code, folder, **environment):
    """Output of a Python program that imports the library from `folder`."""
    known = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=known | environment,
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def copy(tmp_path):
    """A copy of the library without anything compiled."""
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(LIBRARY, tmp_path / "dcreg", ignore=ignore)
    return tmp_path


def compiled(folder):
    return {path.parent.name for path in folder.rglob("*.nbc")}


def test_import_writes_and_removes_nothing(copy):
    old = copy / "dcreg/kernels/__pycache__/kernels-0123456789abcdef"
    old.mkdir(parents=True)
    (old / "some.nbc").touch()
    before = set(copy.rglob("*"))
    code = "import dcreg.families.rigid3d.kernels.rigid, dcreg.families.similarity2d.kernels.bounds"
    run(code, copy, PYTHONDONTWRITEBYTECODE="1")
    assert set(copy.rglob("*")) == before


def test_an_edited_callee_in_another_file_is_compiled_anew(copy):
    """Both kernels stay in the cache, each under the digest of its sources."""
    caller = copy / "dcreg/kernels/caller.py"
    caller.write_text(
        "from dcreg.assignment.kernels.selection import total\n"
        "from dcreg.jit import jit\n\n\n"
        "@jit\ndef twice(values):\n    return 2.0 * total(values)\n"
    )
    code = "import numpy as np\nfrom dcreg.kernels.caller import twice\nprint(twice(np.ones(4)))"
    assert run(code, copy) == "8.0"
    first = compiled(copy)
    callee = copy / "dcreg/assignment/kernels/selection.py"
    text = callee.read_text()
    callee.write_text(text.replace("found += values[i]", "found += 10.0 * values[i]"))
    assert run(code, copy) == "80.0"
    assert len(first) == 1
    assert len(compiled(copy)) == 2
    callee.write_text(text)
    assert run(code, copy) == "8.0"
    assert len(compiled(copy)) == 2  # the first ones served again


def test_old_kernels_go_when_asked(copy):
    old = copy / "dcreg/kernels/plane/__pycache__/kernels-0123456789abcdef"
    old.mkdir(parents=True)
    run(SUM, copy)
    run("from dcreg.jit import forget_old_kernels\nforget_old_kernels()", copy)
    assert not old.exists()
    assert len(compiled(copy)) == 1


def test_kernels_of_a_chosen_folder(copy, tmp_path_factory):
    chosen = tmp_path_factory.mktemp("chosen")
    assert run(SUM, copy, NUMBA_CACHE_DIR=str(chosen)) == "4.0"
    assert compiled(chosen)
    assert not compiled(copy)


@pytest.mark.parametrize("home", [True, False])
def test_a_library_that_cannot_be_written_to_still_works(home, copy, tmp_path_factory):
    """The user's own cache serves, or none."""
    cache = tmp_path_factory.mktemp("home")
    # also where the tests are run by a user who may write anywhere
    code = (
        "import os\nmay = os.access\n"
        f"os.access = lambda path, mode: {home} and str(path).startswith({str(cache)!r})\n" + SUM
    )
    assert run(code, copy, XDG_CACHE_HOME=str(cache), HOME=str(cache)) == "4.0"
    assert not compiled(copy)
    assert bool(compiled(cache)) == home


def test_processes_that_compile_at_once_agree(copy):
    code = [sys.executable, "-c", SUM]
    known = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    both = [subprocess.Popen(code, cwd=copy, env=known, stdout=subprocess.PIPE) for _ in range(2)]
    assert [process.communicate()[0].strip() for process in both] == [b"4.0", b"4.0"]
    assert run(SUM, copy) == "4.0"


WARM = """
import logging
logging.basicConfig(level=logging.INFO, format="%(message)s", force=True)
import numpy as np
import dcreg
from numba.core import event
from dcreg.modes import find_mode
from dcreg.driver.warm_up import warm_up_mode
warm_up_mode(find_mode("{model}", "{mode}"), {bound!r}, {restricted})
seen = event.RecordingListener()
points = np.random.default_rng(1).standard_normal((15, {dim}))
noise = 0.05 * np.random.default_rng(2).standard_normal((15, {dim}))
mask = np.ones((15, 15), bool)
mask[0, 3] = False
with event.install_listener("numba:compile", seen):
    for k in (12, 15):
        dcreg.register(
            points, points + noise, n_inliers=k, model="{model}", mode="{mode}", bound={bound!r},
            node_limit=60, candidates=mask if {restricted} else None,
        )
print([e.data["dispatcher"].py_func.__name__ for _, e in seen.buffer if e.is_start])
"""


@pytest.mark.parametrize("restricted", [False, True])
@pytest.mark.parametrize(
    ("model", "mode", "bound"),
    [
        ("similarity2d", "paper", None),
        ("similarity2d", "paper", "shared"),
        ("similarity2d", "paper", "dc+interval"),
        ("rigid3d", "paper", None),
        ("rigid3d", "paper", "interval"),
        ("rigid3d", "full", None),
    ],
)
def test_a_search_compiles_nothing_after_its_warm_up(model, mode, bound, restricted):
    code = WARM.format(
        model=model,
        mode=mode,
        bound=bound,
        restricted=restricted,
        dim=2 if mode == "paper" and model == "similarity2d" else 3,
    )
    assert run(code, LIBRARY.parent) == "[]"


def test_a_cold_cache_is_told_of_and_a_warm_one_is_not(copy):
    code = WARM.format(model="similarity2d", mode="paper", bound=None, restricted=False, dim=2)
    code = code.replace("import logging\n", "import logging, sys\n", 1)
    code = code.replace("force=True", "force=True, stream=sys.stdout")
    assert run(code, copy).splitlines()[0].startswith("compiling")
    assert run(code, copy) == "[]"


def test_the_whole_warm_up_meets_every_bound():
    for model in MODEL_DIM:
        met = {
            part
            for work in _works()
            if work.args and work.args[0] == model and len(work.args[2]) > 1
            for bound in work.args[2]
            for part in bound_parts(bound or DEFAULT_BOUND)
        }
        assert met == set(BOUND_NAMES)
