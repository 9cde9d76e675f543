"""Where compiled kernels are kept on disk.

Numba recompiles a function when its own file changes, but not when a kernel that it calls in another
file changes. Compiled kernels therefore lie in a folder named after the digest of all kernel sources.
An edit of any of them starts an empty folder, so machine code of different sources never mixes, even
where processes with different sources run at the same time.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.runtime import rtsys
from numba.misc.appdirs import AppDirs

HERE = Path(__file__).parent
LIBRARY = HERE.parent
_PREFIX = "kernels-"
# Importing `NEVER` compiles nothing: an edit of such a file leaves the compiled kernels valid.
_IMPORTS_JIT = re.compile(
    rb"from dcreg\.jit import [^)]*?\bjit|import dcreg\.jit|from dcreg import jit"
)


def _kernels_in(package: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield the files that compile functions, and those that their functions are made of."""
    for folder, subfolders, names in os.walk(package):
        if "__pycache__" in subfolders:
            subfolders.remove("__pycache__")
        for path in (Path(folder, name) for name in names if name.endswith(".py")):
            source = path.read_bytes()
            if "kernels" in path.with_suffix("").parts or _IMPORTS_JIT.search(source):
                yield path, source


@functools.cache
def digest_of(package: Path) -> str:
    """Return the digest of the library's kernels and of the files in `package` that compile others."""
    sources = {path: path.read_bytes() for path in HERE.glob("*.py")}
    for root in {LIBRARY, package}:
        sources.update(_kernels_in(root))
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(sources[path])
    return digest.hexdigest()[:16]


def _package_of(file: Path) -> Path:
    """Return the outermost package that holds a file, or its folder."""
    folder = file.parent
    while (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder


@functools.cache
def cache_folder(file: Path) -> Path | None:
    """Return the folder for the compiled functions of a source file: next to it or in the user's cache.

    None where neither is writable: each process then compiles its kernels again.
    """
    package = _package_of(file)
    name = _PREFIX + digest_of(package)
    next_to_it = file.parent / "__pycache__"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen) / name / file.parent.relative_to(package.parent)
    if _is_writable(next_to_it) or (next_to_it / name).is_dir():
        return next_to_it / name
    users = Path(AppDirs(appname="dcreg", appauthor=False).user_cache_dir)
    return users / name / file.parent.relative_to(package.parent) if _is_writable(users) else None


def _is_writable(folder: Path) -> bool:
    """Whether files can be written to a folder, or to the folder in which it would be created."""
    while not folder.exists():
        folder = folder.parent
    return os.access(folder, os.W_OK)


def forget_old_kernels() -> None:
    """Remove compiled kernels of other sources from the library's folders."""
    for folder in LIBRARY.rglob(f"__pycache__/{_PREFIX}*"):
        if folder.name != _PREFIX + digest_of(LIBRARY):
            shutil.rmtree(folder, ignore_errors=True)


class _Locator(_CacheLocator):
    """Gives Numba the folder of `cache_folder`, whose name identifies the sources."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file, self._folder = py_file, str(cache_folder(Path(py_file)))

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator:
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return Path(self._folder).name

    def get_disambiguator(self) -> None:
        return None


class _CacheImpl(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 (declared by Numba without ClassVar)


class KernelCache(FunctionCache):
    """Keeps the compiled versions of one kernel."""

    _impl_class = _CacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load a kernel without preparing to compile, which takes 0.2 s; compiling does so itself."""
        rtsys.initialize(target_context)  # the memory of arrays
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)
