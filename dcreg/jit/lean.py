"""Compile with fewer steps: Numba often repeats work or computes what its nopython mode does not need."""

from __future__ import annotations

import contextlib
import functools
import threading
import types
from collections.abc import Iterable, Iterator
from typing import Any

import llvmlite.binding as llvm
from numba.core import errors, inline_closurecall, ir, ssa, transforms, typeinfer
from numba.core.inline_closurecall import InlineWorker
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.types.functions import Function
from numba.extending import overload
from numba.np import arrayobj

_VARIABLE: Any = ir.Var
_ERRORS: Any = errors
_LOCK = threading.Lock()
_OPEN: list[contextlib.ExitStack] = []  # a context each; the first one restores Numba


@contextlib.contextmanager
def lean_numba() -> Iterator[None]:
    """A context in which Numba compiles with fewer steps, in all threads and for all its users."""
    _enter()
    try:
        yield
    finally:
        _leave()


def _enter() -> None:
    with _LOCK, contextlib.ExitStack() as changes:
        if not _OPEN:
            on_lock = llvm.ffi.lib._lock._cblist
            changes.callback(on_lock.extend, on_lock[:])
            on_lock.clear()  # two events for each of 60,000 calls of LLVM
            for change in _changes():
                changes.enter_context(_changed(*change))
        _OPEN.append(changes.pop_all())


def _leave() -> None:
    """Restore Numba in the last context that ends, whichever began first."""
    with _LOCK:
        last = _OPEN.pop()
        if not _OPEN:
            last.close()


@contextlib.contextmanager
def _changed(owner: Any, name: str, value: Any) -> Iterator[None]:
    usual = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, usual)


def _no_context(*_: Any, **__: Any) -> contextlib.AbstractContextManager[None]:
    return contextlib.nullcontext()


def _changes() -> Iterator[tuple[Any, str, Any]]:
    """Yield the owner, the name and the new value of what changes in Numba."""
    yield TargetConfig, "values", _flags
    yield ir.Stmt, "list_vars", lambda self: _variables(self.__dict__.values())
    yield ir.Expr, "list_vars", lambda self: _variables(self._kws.values())
    yield PostProcessor, "run", _with_run(PostProcessor.run)
    yield Function, "get_call_type", _with_memory(Function.get_call_type)
    yield InlineWorker, "inline_function", _without_copies(InlineWorker.inline_function)
    # type errors name their line without it, other errors only that in the function called
    yield typeinfer, "new_error_context", _no_context
    # Numba's own formats both shapes, which takes seconds to compile
    yield arrayobj, "raise_with_shape_context", _refuse_shapes
    # warnings name the line of Numba that issues them, not that of the kernel
    yield _ERRORS.WarningsFixer, "catch_warnings", _no_context
    yield ssa, "_logger", types.SimpleNamespace(debug=lambda *_: None)


def _refuse_shapes(given: Any, expected: Any) -> Any:
    raise ValueError("cannot assign an array of this shape: it differs from that of the slice")


@overload(_refuse_shapes)
def _compiled_refusal(given: Any, expected: Any) -> Any:
    return _refuse_shapes


@functools.cache
def _default_flags(kind: Any) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


def _flags(self: Any) -> dict[str, Any]:
    return _default_flags(self.__class__) | self._values


def _variables(values: Iterable[Any]) -> list[Any]:
    """List the variables of an instruction whose parts are these."""
    found: list[Any] = []
    for value in values:
        if isinstance(value, _VARIABLE):
            found.append(value)
        elif isinstance(value, ir.Inst):
            found += value.list_vars()
        elif isinstance(value, list | tuple):
            found += _variables(value)
        elif isinstance(value, dict):
            found += _variables(value.values())
    return found


def _with_run(usual: Any) -> Any:
    """Skip the search for live variables, except for generators and where references are counted."""

    def run(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        if emit_dels or self.func_ir.is_generator:
            usual(self, emit_dels, extend_lifetimes)
            return
        self.func_ir.blocks = transforms.canonicalize_cfg(self.func_ir.blocks)
        self.func_ir.variable_lifetime = VariableLifetime(self.func_ir.blocks)
        self.func_ir.generator_info = None

    return run


def _without_copies(usual: Any) -> Any:
    """Inline a function without copying it: it was parsed for this place only."""
    no_copies = types.SimpleNamespace(deepcopy=lambda block: block)

    def inline_function(
        self: Any, caller: Any, block: Any, at: int, function: Any, arg_typs: Any = None
    ) -> Any:
        if self._permit_update_type_and_call_maps:  # an extension of Numba, which infers types here
            return usual(self, caller, block, at, function, arg_typs)
        callee, free = self.run_untyped_passes(function), function.__code__.co_freevars
        with _changed(inline_closurecall, "copy", no_copies):
            return self.inline_ir(caller, block, at, callee, free, arg_typs=arg_typs)

    return inline_function


def _with_memory(usual: Any) -> Any:
    """Remember the signatures of calls without keywords of functions that Numba provides."""
    known: dict[Any, tuple[Any, Any]] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return usual(self, context, args, kws)
        call = (self, context, tuple(args), _inherited())
        if call not in known:
            signature = usual(self, context, args, kws)
            known[call] = signature, self._impl_keys[signature.args]
        signature, self._impl_keys[signature.args] = known[call]
        return signature

    return get_call_type


def _inherited() -> tuple[Any, ...]:
    """Return the options of a kernel that hold for Numba's functions in it, too."""
    flags = ConfigStack.top_or_none()
    if flags is None:
        return ()
    return flags.nrt, frozenset(flags.fastmath.flags), flags.error_model, flags.forceinline
