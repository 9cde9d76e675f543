"""The cache of compiled kernels: what is compiled when, and that machine code fits its sources."""

import gc
import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numba as nb
import numpy as np
import pytest
from numba.core import event
from numba.core.caching import NullCache
from numba.core.runtime import _nrt_python, rtsys

import dcreg
from dcreg import jit as jit_module
from dcreg.driver import warm_up
from dcreg.driver.modes import find_mode
from dcreg.families.rigid3d.cover import CongruentCover
from dcreg.families.similarity2d.cover import NearestCover
from dcreg.families.similarity2d.kernels.exclusion import divide_boxes
from dcreg.jit import is_compiled, jit, lean
from dcreg.names import BOUND_NAMES

LIBRARY = Path(dcreg.__file__).parent
SUM = "from dcreg.assignment.kernels.selection import total\nimport numpy as np\n"
SUM += "print(total(np.ones(4)))"


@pytest.fixture(scope="module", autouse=True)
def quick_compilation():
    """Not here: these tests are about the shorter compilation itself."""


def run(code, folder, **environment):
    """Output of a Python program that imports the library from `folder`."""
    known = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=known | environment,
        capture_output=True, text=True, timeout=1200,
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
    old = copy / "dcreg/search/__pycache__/kernels-0123456789abcdef"
    old.mkdir(parents=True)
    (old / "some.nbc").touch()
    before = set(copy.rglob("*"))
    code = (
        "import dcreg.families.rigid3d.kernels.boxes, dcreg.families.similarity2d.kernels.vertices"
    )
    run(code, copy, PYTHONDONTWRITEBYTECODE="1")
    assert set(copy.rglob("*")) == before


def test_an_edited_callee_in_another_file_is_compiled_again(copy):
    """Both kernels stay in the cache, each under the digest of its sources."""
    caller = copy / "dcreg/assignment/kernels/caller.py"
    caller.write_text(
        "from dcreg.assignment.kernels.selection import total\n"
        "from dcreg.jit import jit\n\n\n"
        "@jit\ndef twice(values):\n    return 2.0 * total(values)\n"
    )
    code = "import numpy as np\nfrom dcreg.assignment.kernels.caller import twice\n"
    code += "print(twice(np.ones(4)))"
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


def test_kernels_of_earlier_sources_are_removed_on_request(copy):
    old = copy / "dcreg/search/__pycache__/kernels-0123456789abcdef"
    old.mkdir(parents=True)
    run(SUM, copy)
    run("from dcreg.jit import forget_old_kernels\nforget_old_kernels()", copy)
    assert not old.exists()
    assert len(compiled(copy)) == 1


def test_numba_cache_dir_holds_the_compiled_kernels(copy, tmp_path_factory):
    chosen = tmp_path_factory.mktemp("chosen")
    assert run(SUM, copy, NUMBA_CACHE_DIR=str(chosen)) == "4.0"
    assert compiled(chosen)
    assert not compiled(copy)


@pytest.mark.parametrize("home", [True, False])
def test_a_read_only_library_still_works(home, copy, tmp_path_factory):
    """The user's own cache serves, or none."""
    cache = tmp_path_factory.mktemp("home")
    # also if the user of the tests may write everywhere
    code = (
        "import os\nmay = os.access\n"
        f"os.access = lambda path, mode: {home} and str(path).startswith({str(cache)!r})\n" + SUM
    )
    assert run(code, copy, XDG_CACHE_HOME=str(cache), HOME=str(cache)) == "4.0"
    assert not compiled(copy)
    assert bool(compiled(cache)) == home


def test_kernels_with_checked_indices_are_not_kept(copy):
    """They would serve runs without checks."""
    assert run(SUM, copy, NUMBA_BOUNDSCHECK="1") == "4.0"
    assert not compiled(copy)


@pytest.mark.parametrize("order", ["C", "F"])
def test_indices_are_checked_on_request(copy, order):
    kernel = copy / "dcreg/assignment/kernels/beyond.py"
    kernel.write_text("from dcreg.jit import jit\n\n\n@jit\ndef at(a, i):\n    return a[i, i]\n")
    code = (
        "import numpy as np\nfrom dcreg.assignment.kernels.beyond import at\n"
        f"try: at(np.ones((2, 2), order='{order}'), 2)\nexcept IndexError: print('checked')"
    )
    assert run(code, copy, NUMBA_BOUNDSCHECK="1") == "checked"


def test_processes_that_compile_at_the_same_time_agree(copy):
    code = [sys.executable, "-c", SUM]
    known = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    both = [subprocess.Popen(code, cwd=copy, env=known, stdout=subprocess.PIPE) for _ in range(2)]
    assert [process.communicate()[0].strip() for process in both] == [b"4.0", b"4.0"]
    assert run(SUM, copy) == "4.0"


# Every case in a forked process, in which nothing is compiled or loaded yet.
WARM = """
import json, os, sys
import numpy as np
import dcreg, dcreg.driver.solve
from numba.core import event
from dcreg.driver.modes import find_mode
from dcreg.driver.warm_up import warm_up_mode
from dcreg.families.rigid3d.kernels.boxes import FEW_PAIRS

def compiled_late(model, mode, bound, restricted, n):
    warm_up_mode(find_mode(model, mode), bound, restricted, many=n * n > FEW_PAIRS)
    seen = event.RecordingListener()
    dim = 2 if model == "similarity2d" else 3
    points = np.random.default_rng(1).standard_normal((n, dim))
    noise = 0.05 * np.random.default_rng(2).standard_normal((n, dim))
    mask = np.ones((n, n), bool)
    mask[0, 3] = False
    with event.install_listener("numba:compile", seen):
        for k in (n - 3, n):
            dcreg.register(
                points, points + noise, n_inliers=k, model=model, node_limit=60,
                candidates=mask if restricted else None,
                options=dcreg.SolveOptions(mode=mode, bound=bound),
            )
    return [e.data["dispatcher"].py_func.__name__ for _, e in seen.buffer if e.is_start]

for case in json.loads(os.environ["CASES"]):
    if not os.fork():
        print(json.dumps([case, compiled_late(*case)]), flush=True)
        os._exit(0)
    os.wait()
"""
SEARCHES = [
    ["similarity2d", "paper", None],
    ["similarity2d", "paper", "shared"],
    ["similarity2d", "paper", "dc+interval"],
    ["rigid3d", "paper", None],
    ["rigid3d", "paper", "interval"],
    ["rigid3d", "full", None],
]


@pytest.mark.timeout(1200)  # where the cache is empty
def test_a_search_compiles_nothing_after_its_warm_up():
    cases = [[*search, restricted, 15] for search in SEARCHES for restricted in (False, True)]
    cases.append(["rigid3d", "full", None, False, 33])  # many pairs
    cache = {k: v for k, v in os.environ.items() if k == "NUMBA_CACHE_DIR"}
    output = run(WARM, LIBRARY.parent, CASES=json.dumps(cases), **cache)
    assert [json.loads(line) for line in output.splitlines()] == [[case, []] for case in cases]


def test_a_compilation_is_announced_and_a_cached_kernel_is_not(copy):
    code = "from dcreg.jit import when_compiling\n"
    code += "with when_compiling(lambda: print('compiling')):\n    "
    code += SUM.replace("\n", "\n    ")
    assert run(code, copy).split() == ["compiling", "4.0"]
    assert run(code, copy) == "4.0"


NO_CACHE = """
from numba.core import caching
del caching._CacheLocator
"""


def test_a_numba_without_its_private_cache_still_compiles(copy):
    """Every process then compiles its kernels."""
    code = "import logging, sys\nlogging.basicConfig(stream=sys.stdout)\n" + NO_CACHE + SUM
    lines = run(code, copy).splitlines()
    assert "compile cache is not supported" in lines[0]
    assert lines[1] == "4.0"
    assert not compiled(copy)


def test_a_warm_up_announces_that_it_compiles(monkeypatch, caplog):
    @contextmanager
    def compiling(tell):
        tell()
        yield

    monkeypatch.setattr(warm_up, "when_compiling", compiling)
    with caplog.at_level("INFO", logger="dcreg"):
        warm_up.warm_up_mode.__wrapped__(find_mode("similarity2d", "paper"), None)
    assert caplog.messages[0].startswith("compiling")


@pytest.mark.parametrize("cover", [NearestCover, CongruentCover])
def test_the_warm_up_of_a_cover_reaches_its_boxes(monkeypatch, cover):
    """A cover that gives up leaves kernels uncompiled."""
    found, confine = [], cover.confine

    def recorded(*given):
        found.append(confine(*given))
        return found[-1]

    monkeypatch.setattr(cover, "confine", recorded)
    warm_up.compile_covers()
    assert found
    assert all(confined is not None and len(confined.boxes) for confined in found)


def test_the_whole_warm_up_meets_every_bound(monkeypatch):
    met = []
    monkeypatch.setattr(warm_up, "warm_up_mode", lambda *given, **_: met.append(given))
    for work in warm_up._works():
        if work.func is not warm_up.warm_up_matches:
            work()
    for model in ("similarity2d", "rigid3d"):
        bounds = {bound or mode.own_bound for mode, bound, *_ in met if mode.model == model}
        assert bounds >= set(BOUND_NAMES)


def test_a_kernel_without_a_cache_is_compiled_only_where_it_ran(monkeypatch):
    monkeypatch.setattr(divide_boxes, "_cache", NullCache())
    assert is_compiled(divide_boxes) == bool(divide_boxes.signatures)
    monkeypatch.setattr(type(divide_boxes), "signatures", property(lambda self: []))
    assert not is_compiled(divide_boxes)


@jit
def move_elements(values, grid, flags, at):
    """Read and write elements by positive, negative and constant indices."""
    values[0] = values[at] + values[-1]
    grid[at, -1] = values[0] + grid[0, at]
    grid[-at, 0] += 1
    flags[at] = not flags[-1]
    return grid[1, 2] + grid[at][at]


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int32, np.uint16])
@pytest.mark.parametrize("order", ["C", "F"])
def test_elements_are_those_of_python(dtype, order):
    grid = np.asarray(np.arange(12).reshape(3, 4), dtype, order=order)
    given = np.arange(5).astype(dtype), grid, np.array([True, False, True])
    ours, plain = copy_of(given), copy_of(given)
    assert move_elements(*ours, 2) == move_elements.py_func(*plain, 2)
    for our, expected in zip(ours, plain, strict=True):
        assert (our == expected).all()


def copy_of(arrays):
    return [array.copy(order="K") for array in arrays]


def test_numba_is_as_before_after_a_compilation():
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in lean._changes()]
    with lean.lean_numba():
        assert all(getattr(owner, name) is not usual for owner, name, usual in before)
    assert all(getattr(owner, name) is usual for owner, name, usual in before)


def test_numba_is_as_before_after_contexts_that_overlap():
    """As those of two threads: the one that began first ends first."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in lean._changes()]
    first, second = lean.lean_numba(), lean.lean_numba()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert all(getattr(owner, name) is not usual for owner, name, usual in before)
    second.__exit__(None, None, None)
    assert all(getattr(owner, name) is usual for owner, name, usual in before)


def test_an_array_of_another_shape_is_refused_without_text_made_in_the_kernel():
    @nb.njit
    def assign(to, given):
        to[:] = given

    with lean.lean_numba():
        to = np.zeros(3)
        assign(to, np.arange(3.0))
    assert to.tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="differs from that of the slice"):
        assign(to, np.zeros(2))


@pytest.mark.parametrize("strict_first", [True, False])
def test_a_strict_kernel_does_not_take_the_maximum_of_a_reduction(strict_first):
    """A reduction may assume finite numbers."""
    strict, loose = (
        nb.njit(error_model="numpy", fastmath=options)(lambda a, b: max(a, b))
        for options in (set(), {"nnan"})
    )
    with lean.lean_numba():
        for kernel in (strict, loose) if strict_first else (loose, strict):
            kernel(1.0, 2.0)
    code = [kernel.inspect_llvm((nb.float64, nb.float64)) for kernel in (strict, loose)]
    assert ["nnan" in text for text in code] == [False, True]


def test_a_compilation_without_the_private_parts_that_save_steps(copy):
    code = "import sys\nsys.modules['dcreg.jit.lean'] = None\n"
    code += "from dcreg.jit import when_compiling\nwith when_compiling(lambda: print('compiling')):\n    "
    code += SUM.replace("\n", "\n    ")
    assert run(code, copy).split() == ["compiling", "4.0"]


def test_a_compilation_after_the_end_of_a_context_changes_nothing():
    """As when another thread begins one at that moment."""
    heard = []
    with jit_module.when_compiling(lambda: heard.append(True)):
        listener = event._registered["numba:compile"][-1]
    listener.on_start(None)
    assert not heard
    assert not lean._OPEN
    assert gc.isenabled()


@pytest.mark.parametrize("model", ["similarity2d", "rigid3d"])
def test_a_search_frees_all_arrays_of_its_kernels(model):
    """Else the references in tuples of arrays are not counted."""

    def left():
        gc.collect()
        counts = rtsys.get_allocation_stats()
        return counts.alloc - counts.free

    points = np.random.default_rng(0).random((12, int(model[-2])))
    settings = {"n_inliers": 10, "model": model, "node_limit": 100}
    dcreg.register(points, points + 0.01, **settings)
    _nrt_python.memsys_enable_stats()
    try:
        before = left()
        dcreg.register(points, points + 0.01, **settings)
        assert left() == before
        assert rtsys.get_allocation_stats().alloc > 0
    finally:
        _nrt_python.memsys_disable_stats()
