"""Compile with fewer steps: Numba repeats work whose results its compiler in nopython mode does not need.

Together this saves about a fifth of the compile time.
"""

from __future__ import annotations

import contextlib
import functools
import types
from collections.abc import Iterable, Iterator
from typing import Any, cast

import llvmlite.binding as llvm
from numba.core import inline_closurecall, ir, ssa, transforms
from numba.core.inline_closurecall import InlineWorker
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import TargetConfig
from numba.core.types.functions import Function

_VARIABLE: Any = ir.Var


@contextlib.contextmanager
def lean_numba() -> Iterator[None]:
    """A context in which Numba compiles with fewer steps, to the same code."""
    on_lock = llvm.ffi.lib._lock._cblist
    events = on_lock[:]
    on_lock.clear()  # two events for each of 60,000 calls of LLVM
    with contextlib.ExitStack() as changes:
        changes.callback(on_lock.extend, events)
        for change in _changes():
            changes.enter_context(_changed(*change))
        yield


@contextlib.contextmanager
def _changed(owner: Any, name: str, value: Any) -> Iterator[None]:
    usual = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, usual)


def _changes() -> Iterator[tuple[Any, str, Any]]:
    """Yield the owner, the name and the new value of what changes in Numba."""
    yield TargetConfig, "values", _flags
    yield ir.Stmt, "list_vars", lambda self: _variables(self.__dict__.values())
    yield ir.Expr, "list_vars", lambda self: _variables(self._kws.values())
    yield PostProcessor, "run", _with_run(PostProcessor.run)
    yield Function, "get_call_type", _with_memory(Function.get_call_type)
    yield InlineWorker, "inline_function", _without_copies(InlineWorker.inline_function)
    yield ssa, "_logger", types.SimpleNamespace(debug=lambda *_: None)


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
    """Find which variables live where only for generators and where references are counted."""

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

    def inline_function(*arguments: Any, **options: Any) -> Any:
        with _changed(inline_closurecall, "copy", no_copies):
            return usual(*arguments, **options)

    return inline_function


def _with_memory(usual: Any) -> Any:
    """Find the types of each call of a function that Numba provides only once."""
    known: dict[Any, Any] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return usual(self, context, args, kws)
        call = (self, context, tuple(args))
        if call not in known:
            known[call] = usual(self, context, args, kws)
        return known[call]

    return cast(Any, get_call_type)
