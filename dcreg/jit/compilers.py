"""Compile kernels in less time than Numba's own compilers: to less code, optimised once.

Numba optimises a function before it is linked into each caller, and again there. An inner kernel of this
library, which only other kernels call, is therefore only prepared for inlining; its callers are optimised
as a whole.
"""

from __future__ import annotations

import copy
import functools
import operator
from typing import Any

import llvmlite.ir as llvm_ir
from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.cpu import CPUContext
from numba.core.runtime.context import NRTContext


class _Library(JITCodeLibrary):
    """Code that Python calls."""

    def _optimize_functions(self, module: Any) -> None:
        module.data_layout = self._codegen._data_layout  # they are optimised with what they call

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


class _ForeignInnerLibrary(JITCodeLibrary):
    """Code of other packages that is only linked into callers: no machine code is generated for it."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _InnerLibrary(_ForeignInnerLibrary):
    """Code of this library that is only linked into callers, and optimised there."""

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager(
            cost="cheap", opt=0, loop_vectorize=False
        )
        passes.run(self._final_module, builder)


class _References(NRTContext):
    """Counts references without looking at the parts of a value that have none."""

    def get_meminfos(self, builder: Any, kind: Any, value: Any) -> list[Any]:
        model = self._context.data_model_manager[kind]
        found = []
        if model.has_nrt_meminfo():
            found.append((kind, model.get_nrt_meminfo(builder, value)))
        for part, get in model.traverse(builder):
            if self._context.data_model_manager[part].contains_nrt_meminfo():
                found.extend(self.get_meminfos(builder, part, get(value)))
        return found


class _Context(CPUContext):
    """Reads and writes single elements of contiguous arrays in a few instructions."""

    @property
    def nrt(self) -> _References:
        return _References(self, self.enable_nrt)

    def get_function(self, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
        if self.enable_boundscheck:
            return super().get_function(fn, sig, _firstcall)
        key = fn.get_impl_key(sig.as_function()) if isinstance(fn, types.Callable) else fn
        if key is operator.getitem and _is_element(*sig.args):
            return functools.partial(_get_element, self, sig)
        if key is operator.setitem and _is_element(*sig.args[:2]) and _is_number(sig.args[2]):
            return functools.partial(_set_element, self, sig)
        return super().get_function(fn, sig, _firstcall)


class _WithoutEntry(CPUContext):
    def get_executable(self, *_: Any) -> Any:
        return object()  # a key: callers find the function by it, and nothing else calls it


class _InnerContext(_WithoutEntry, _Context):
    pass


def _is_number(kind: Any) -> bool:
    return isinstance(kind, types.Number | types.Boolean)


def _is_element(array: Any, index: Any) -> bool:
    """Whether an index selects one number of an array in C order."""
    return (
        isinstance(array, types.Array)
        and array.layout == "C"
        and array.ndim > 0
        and _is_number(array.dtype)
        and len(_axes(index)) == array.ndim
        and all(isinstance(axis, types.Integer) for axis in _axes(index))
    )


def _axes(index: Any) -> tuple[Any, ...]:
    return index.types if isinstance(index, types.UniTuple | types.Tuple) else (index,)


def _get_element(context: Any, sig: Any, builder: Any, args: Any, loc: Any = None) -> Any:
    kind = sig.args[0]
    pointer = _pointer(context, builder, sig.args, *args)
    return context.unpack_value(builder, kind.dtype, pointer, align=None if kind.aligned else 1)


def _set_element(context: Any, sig: Any, builder: Any, args: Any, loc: Any = None) -> None:
    kind = sig.args[0]
    pointer = _pointer(context, builder, sig.args, *args[:2])
    value = context.cast(builder, args[2], sig.args[2], kind.dtype)
    align = None if kind.aligned else 1
    context.pack_value(builder, kind.dtype, value, pointer, align=align)


def _pointer(context: Any, builder: Any, kinds: Any, array: Any, index: Any) -> Any:
    """Point to an element. As in Python, negative indices count from the end."""
    fields = context.data_model_manager[kinds[0]]
    data, shape = fields.get_field_position("data"), fields.get_field_position("shape")
    place = None
    for axis, kind in enumerate(_axes(kinds[1])):
        at = builder.extract_value(index, axis) if kinds[1] is not kind else index
        at = context.cast(builder, at, kind, types.intp)
        size = builder.extract_value(array, [shape, axis])
        if kind.signed and not (isinstance(at, llvm_ir.Constant) and at.constant >= 0):
            is_negative = builder.icmp_signed("<", at, at.type(0))
            at = builder.select(is_negative, builder.add(at, size), at)
        place = at if place is None else builder.add(builder.mul(place, size), at)
    return builder.gep(builder.extract_value(array, data), [place])


class KernelCompiler(Compiler):
    """Compiles kernels that Python calls."""

    _library_class: Any = _Library
    _context_class: Any = _Context

    def __init__(self, typing: Any, target: Any, library: Any, *arguments: Any) -> None:
        library = self._library_class(target.codegen(), "kernel")
        library.enable_object_caching()
        super().__init__(typing, target, library, *arguments)
        self.state.targetctx = copy.copy(self.state.targetctx)
        self.state.targetctx.__class__ = self._context_class


class InnerCompiler(KernelCompiler):
    """Compiles functions that only other kernels call: without an entry from Python."""

    _library_class: Any = _InnerLibrary
    _context_class: Any = _InnerContext


class ForeignInnerCompiler(KernelCompiler):
    """Compiles inner functions of other packages, to the code of Numba's own compiler."""

    _library_class = _ForeignInnerLibrary
    _context_class = _WithoutEntry
