"""Compile kernels: cached on disk, and without Python's global lock so that threads run in parallel.

`dcreg.jit.cache` keeps compiled kernels; `dcreg.jit.compilers` and `dcreg.jit.lean` make Numba faster.

With ``NUMBA_DISABLE_JIT=1`` kernels run as plain Python, for debuggers and coverage: slowly, and with the
same results up to rounding.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numba import config, extending

try:  # private parts of Numba, which a later version may move
    from numba.core import event

    from dcreg.jit.cache import KernelCache, cache_folder, forget_old_kernels
    from dcreg.jit.compilers import ForeignInnerCompiler, InnerCompiler, KernelCompiler

    HAS_CACHE = True
except ImportError:
    HAS_CACHE = False
    logging.getLogger("dcreg").warning(
        "numba %s: its compile cache is not supported, so each process compiles its kernels again; "
        "install a version that the requirements of dcreg admit",
        nb.__version__,
    )

    def forget_old_kernels() -> None:
        """Remove nothing: no kernels are kept."""


INTERPRETED = bool(getattr(config, "DISABLE_JIT", False))  # kernels run as plain Python
_LLVM_LEVEL = 1
_SETTINGS: Any = config  # of Numba, which sets them at run time


@contextlib.contextmanager
def when_compiling(announce: Callable[[], None]) -> Iterator[None]:
    """A context in which `announce` is called before a kernel is compiled for the first time.

    Loading kernels from the cache does not call it. Compiling allocates millions of objects that stay
    alive: the garbage collector pauses until the context ends, which saves a tenth of the time. From the
    first compilation until then, Numba compiles with fewer steps, also for other threads
    (`dcreg.jit.lean`).
    """
    if not HAS_CACHE:
        yield
        return
    undo, once = contextlib.ExitStack(), threading.Lock()

    class FirstCompilation(event.Listener):
        announced = False

        def on_start(self, event: Any) -> None:  # of any thread
            with once:
                if self.announced:
                    return
                self.announced = True
                if gc.isenabled():
                    gc.disable()
                    undo.callback(gc.enable)
                # another Numba may lack some of these parts
                with contextlib.suppress(ImportError, AttributeError):
                    from dcreg.jit.lean import lean_numba

                    undo.enter_context(lean_numba())
            announce()

        def on_end(self, event: Any) -> None:
            pass

    listener = FirstCompilation()
    with undo, event.install_listener("numba:compile", listener):
        try:
            yield
        finally:
            with once:
                listener.announced = True  # other threads change nothing from here on


# Kernels are called from Python and from each other, never by address: they need no entry in C.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def _at_low_level(compile_core: Callable[..., Any]) -> Callable[..., Any]:
    """Compile at LLVM's level 1, not 3: in a tenth less time; searches take as long as before.

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


def _is_own(function: Any) -> bool:
    """Whether a function belongs to this library.

    Kernels of other methods keep Numba's level of optimisation, because some would slow down.
    """
    return function.__module__.startswith("dcreg.")


def _numba_kernel(function: Any, **options: Any) -> Any:
    kernel: Any = nb.njit(**_OPTIONS, **options)(function)
    if HAS_CACHE and _is_own(function):
        kernel._compiler._compile_core = _at_low_level(kernel._compiler._compile_core)
    return kernel


def _make_kernel(function: Any, **options: Any) -> Any:
    """Return the compiled function, with its cache on disk."""
    if HAS_CACHE and _is_own(function):
        options["pipeline_class"] = KernelCompiler
    kernel = _numba_kernel(function, **options)
    is_plain = not (_SETTINGS.BOUNDSCHECK or _SETTINGS.DEBUGINFO_DEFAULT)
    if HAS_CACHE and is_plain and cache_folder(Path(function.__code__.co_filename)) is not None:
        kernel._cache = KernelCache(function)
    return kernel


def _make_inner_kernel(function: Any, **options: Any) -> Any:
    """Return a compiled function for other kernels, whose cached code contains it.

    The first call from Python, as in a test, compiles another version of it.
    """
    if not HAS_CACHE:
        return _make_kernel(function, **options)
    compiler = InnerCompiler if _is_own(function) else ForeignInnerCompiler
    kernel = _numba_kernel(function, no_cpython_wrapper=True, pipeline_class=compiler, **options)

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
# For reductions over finite numbers in any order and with fused multiply-adds: lets the compiler
# vectorise a minimum.
jit_reduction: Any = _compiled(
    make=_make_inner_kernel, fastmath={"nnan", "nsz", "reassoc", "contract"}
)


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
