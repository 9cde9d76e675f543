"""Compile kernels: cached on disk, and without Python's global lock so that threads run in parallel.

Numba recompiles a function when its own file changes, but not when a kernel that it calls in another
file changes. Compiled kernels therefore lie in a folder named after the digest of all kernel sources.
An edit of any of them starts an empty folder, so machine code of different sources never mixes, even
where processes with different sources run at the same time.

With ``NUMBA_DISABLE_JIT=1`` kernels run as plain Python, for debuggers and coverage: slowly, and with the
same results up to rounding.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import gc
import hashlib
import logging
import os
import re
import shutil
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import llvmlite.binding as llvm
import numba as nb
import numpy as np
from numba import config, extending

try:  # private parts of Numba, which a later version may move
    from numba.core import event
    from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler
    from numba.core.runtime import rtsys
    from numba.core.targetconfig import TargetConfig
    from numba.misc.appdirs import AppDirs

    HAS_CACHE = True
except ImportError:
    HAS_CACHE = False
    logging.getLogger("dcreg").warning(
        "numba %s: its compile cache is not supported, so each process compiles its kernels again; "
        "install a version that the requirements of dcreg admit",
        nb.__version__,
    )

HERE = Path(__file__).parent
INTERPRETED = bool(getattr(config, "DISABLE_JIT", False))  # kernels run as plain Python
_PREFIX = "kernels-"
_LLVM_LEVEL = 1
_SETTINGS: Any = config  # of Numba, which sets them at run time
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
    sources = {Path(__file__): Path(__file__).read_bytes()}
    for root in {HERE, package}:
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
    if not HAS_CACHE:
        return None
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


@contextlib.contextmanager
def when_compiling(announce: Callable[[], None]) -> Iterator[None]:
    """A context in which `announce` is called before a kernel is compiled for the first time.

    Loading kernels from the cache does not call it. Compiling allocates millions of objects that stay
    alive: the garbage collector pauses until the context ends, which saves a tenth of the time.
    """
    if not HAS_CACHE:
        yield
        return
    undo = contextlib.ExitStack()

    class FirstCompilation(event.Listener):
        announced = False

        def on_start(self, event: Any) -> None:
            if not self.announced:
                self.announced = True
                if gc.isenabled():
                    gc.disable()
                    undo.callback(gc.enable)
                undo.enter_context(_lean_numba())
                announce()

        def on_end(self, event: Any) -> None:
            pass

    with undo, event.install_listener("numba:compile", FirstCompilation()):
        yield


@functools.cache
def _default_flags(kind: Any) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


@contextlib.contextmanager
def _lean_numba() -> Iterator[None]:
    """Skip Numba's events for profilers, and read its flags faster: saves 6 % of the compile time."""
    on_lock, flags = llvm.ffi.lib._lock._cblist, cast(Any, TargetConfig)
    events, values = on_lock[:], flags.values
    on_lock.clear()  # two events for each of 60,000 calls of LLVM
    flags.values = lambda self: _default_flags(self.__class__) | self._values
    try:
        yield
    finally:
        on_lock[:], flags.values = events, values


def forget_old_kernels() -> None:
    """Remove compiled kernels of other sources from the library's folders."""
    for folder in HERE.rglob(f"__pycache__/{_PREFIX}*"):
        if folder.name != _PREFIX + digest_of(HERE):
            shutil.rmtree(folder, ignore_errors=True)


if HAS_CACHE:

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

    class _Cache(FunctionCache):
        _impl_class = _CacheImpl

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            """Load a kernel without preparing to compile, which takes 0.2 s; compiling does so itself."""
            rtsys.initialize(target_context)  # the memory of arrays
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)

    class _InnerLibrary(JITCodeLibrary):
        """Code that is only linked into callers, so no machine code is generated for it alone."""

        def _finalize_final_module(self) -> None:
            self._finalize_dynamic_globals()
            self._finalized = True

        def serialize_using_object_code(self) -> Any:
            return self.serialize_using_bitcode()

    class _InnerCompiler(Compiler):
        """Compiles functions that other kernels call: without an entry from Python."""

        def __init__(self, typing: Any, target: Any, library: Any, *arguments: Any) -> None:
            library = _InnerLibrary(target.codegen(), "inner kernel")
            super().__init__(typing, target, library, *arguments)
            self.state.targetctx = copy.copy(self.state.targetctx)
            self.state.targetctx.get_executable = _no_entry

    def _no_entry(*_: Any) -> Any:
        return object()  # a key: callers find the function by it


# Kernels are called from Python and from each other, never by address: they need no entry in C.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def _at_low_level(compile_core: Callable[..., Any]) -> Callable[..., Any]:
    """Compile at LLVM's level 1, not 3: in a tenth less time, and searches take as long.

    Numba holds its lock while it compiles, so no other thread sees the level.
    """

    def compile_kernel(*args: Any) -> Any:
        level = _SETTINGS.OPT
        _SETTINGS.OPT = min(level, type(level)(_LLVM_LEVEL))
        try:
            return compile_core(*args)
        finally:
            _SETTINGS.OPT = level

    return compile_kernel


def _make_kernel(function: Any, **options: Any) -> Any:
    """Return the compiled function, with its cache on disk."""
    kernel: Any = nb.njit(**_OPTIONS, **options)(function)
    # some kernels of other methods slow down
    if HAS_CACHE and function.__module__.startswith("dcreg."):
        kernel._compiler._compile_core = _at_low_level(kernel._compiler._compile_core)
    if cache_folder(Path(function.__code__.co_filename)) is not None:
        kernel._cache = _Cache(function)
    return kernel


def _make_inner_kernel(function: Any, **options: Any) -> Any:
    """Return a compiled function for other kernels, which needs a fifth less time.

    The first call from Python, as in a test, compiles another version of it.
    """
    if not HAS_CACHE:
        return _make_kernel(function, **options)
    kernel = _make_kernel(
        function, no_cpython_wrapper=True, pipeline_class=_InnerCompiler, **options
    )

    def add_overload(compiled: Any) -> None:
        kernel.overloads[tuple(compiled.signature.args)] = compiled

    @functools.cache
    def outer() -> Any:
        copied = types.FunctionType(
            function.__code__, function.__globals__, function.__name__, function.__defaults__
        )
        copied.__qualname__ = f"{function.__qualname__}.outer"  # the name of its cache
        return _make_kernel(copied, **options)

    kernel.add_overload = add_overload
    kernel._compile_for_args = lambda *_, **__: outer()
    return kernel


def _compiled(*, make: Callable[..., Any] = _make_kernel, **options: Any) -> Any:
    def decorate(function: Any) -> Any:
        if INTERPRETED:  # compiled arithmetic does not warn either
            return np.errstate(all="ignore")(function)
        # other modules do not call private kernels
        is_inner = function.__name__.startswith("_") and "inline" not in options
        return (_make_inner_kernel if is_inner else make)(function, **options)

    return decorate


jit: Any = _compiled()
# For functions that only other kernels call.
jit_inner: Any = _compiled(make=_make_inner_kernel)
# For a part of one kernel: compiled as if it stood there, in less time than as a separate function.
# Not for loops that have to be vectorised: the compiler does that best in a separate function.
jit_part: Any = _compiled(inline="always")
# For reductions over finite numbers in any order: lets the compiler vectorise a minimum.
jit_reduction: Any = _compiled(make=_make_inner_kernel, fastmath={"nnan", "nsz", "reassoc"})


def is_compiled(kernel: Any) -> bool:
    """Tell whether a kernel need not be compiled, in this process or in an earlier one."""
    if INTERPRETED or kernel.signatures:
        return True
    folder, name = kernel._cache.cache_path, kernel.py_func.__name__
    # without a folder, kernels are compiled in every process
    return folder is not None and any(Path(folder).glob(f"*.{name}-*.nbi"))


def intrinsic(stand_in: Any) -> Any:
    """Decorate an intrinsic of Numba; `stand_in` replaces it where kernels run as plain Python."""
    return lambda function: stand_in if INTERPRETED else extending.intrinsic(function)


# A stop flag that is never set.
NEVER = np.zeros(1, np.uint8)
