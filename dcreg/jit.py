"""The one way kernels are compiled: cached on disk, and free of Python's lock so threads can run.

Numba recompiles a function when its own file changes, not when a kernel it calls in another file does.
So compiled kernels lie in a folder named after the digest of all kernel sources: an edit of any of
them starts an empty folder, and old and new machine code never meet, not even where processes with
different sources run side by side.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numba.core import caching, event
from numba.misc.appdirs import AppDirs

HERE = Path(__file__).parent
_PREFIX = "kernels-"
# Importing `NEVER` compiles nothing: an edit of such a file leaves the compiled kernels valid.
_IMPORTS_JIT = re.compile(
    r"from dcreg\.jit import [^)]*?\bjit|import dcreg\.jit|from dcreg import jit"
)


def _kernels_in(package: Path) -> Iterator[Path]:
    """Yield the files that compile functions, and those that their functions are made of."""
    for path in package.rglob("*.py"):
        text = path.read_text("utf-8")
        if "kernels" in path.with_suffix("").parts or _IMPORTS_JIT.search(text):
            yield path


@functools.cache
def digest_of(package: Path) -> str:
    """Digest of the library's kernels, and of the files in `package` that compile others with them."""
    sources = {path for root in (HERE, package) for path in _kernels_in(root)}
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _package_of(file: Path) -> Path:
    """The outermost package that holds a file, or its folder."""
    folder = file.parent
    while (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder


@functools.cache
def cache_folder(file: Path) -> Path | None:
    """Where the compiled functions of a source file are kept: beside it, or else in the user's cache.

    None where neither can be written: then every process compiles anew.
    """
    package = _package_of(file)
    name = _PREFIX + digest_of(package)
    beside = file.parent / "__pycache__"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen) / name / file.parent.relative_to(package.parent)
    if _is_writable(beside) or (beside / name).is_dir():
        return beside / name
    users = Path(AppDirs(appname="dcreg", appauthor=False).user_cache_dir)
    return users / name / file.parent.relative_to(package.parent) if _is_writable(users) else None


def _is_writable(folder: Path) -> bool:
    """Whether files can be written to a folder, or to the one where it would be made."""
    while not folder.exists():
        folder = folder.parent
    return os.access(folder, os.W_OK)


class _FirstCompilation(event.Listener):
    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: event.Event) -> None:
        tell, self._tell = self._tell, None
        if tell is not None:
            tell()

    def on_end(self, event: event.Event) -> None:
        pass


@contextlib.contextmanager
def when_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """A context in which `tell` is called before a kernel is compiled for the first time.

    Kernels that lie in the cache are loaded without a word. Compiling makes millions of objects that
    live on: the garbage collector waits until it is over, which saves a tenth of the time.
    """
    collecting = gc.isenabled()

    def begin() -> None:
        gc.disable()
        tell()

    try:
        with event.install_listener("numba:compile", _FirstCompilation(begin)):
            yield
    finally:
        if collecting:
            gc.enable()


def forget_old_kernels() -> None:
    """Remove compiled kernels of other sources from the library's folders."""
    for folder in HERE.rglob(f"__pycache__/{_PREFIX}*"):
        if folder.name != _PREFIX + digest_of(HERE):
            shutil.rmtree(folder, ignore_errors=True)


class _Locator(caching._CacheLocator):
    """Tells Numba the folder of `cache_folder`; its name stands for the sources."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._folder = str(cache_folder(Path(py_file)))

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator:
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return Path(self._folder).name

    def get_disambiguator(self) -> None:
        return None


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 (declared by Numba without ClassVar)


class _Cache(caching.FunctionCache):
    _impl_class = _CacheImpl


# Kernels are called from Python and from each other, never by address: they need no entry in C.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def _compiled(**options: Any) -> Any:
    def decorate(function: Any) -> Any:
        # a private one is called by other kernels alone and needs no entry from Python
        inner: dict[str, Any] = {"no_cpython_wrapper": function.__name__.startswith("_")}
        kernel: Any = nb.njit(**inner, **_OPTIONS, **options)(function)
        if cache_folder(Path(function.__code__.co_filename)) is not None:
            kernel._cache = _Cache(function)
        return kernel

    return decorate


jit: Any = _compiled()
# For a part of one kernel: compiled as if it stood there, in less time than as a function of its own.
# Not for loops that have to be vectorised: the compiler does that best in a function of their own.
jit_part: Any = _compiled(inline="always")
# For reductions over finite numbers whose order is free: lets the compiler vectorise a minimum.
jit_reduction: Any = _compiled(fastmath={"nnan", "nsz", "reassoc"})

# A stop flag that is never set.
NEVER = np.zeros(1, np.uint8)
