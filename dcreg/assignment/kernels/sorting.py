"""Sort many arrays of one length at once, as the columns of a table.

A sorting network makes the same comparisons for every input. So each step takes two rows and orders all
their columns by one vector minimum and one vector maximum, without branches. The network is bitonic, in
the form in which each comparison moves the smaller number up. Rows beyond the last one count as
infinite, so the number of rows is arbitrary.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from dcreg.jit import intrinsic, jit

COLUMNS = 8  # doubles in the widest vector registers; narrower registers take them in parts
_ROW = ir.VectorType(ir.DoubleType(), COLUMNS)


def _network(*pairs):
    """Return a function ``(table, first, step)`` that orders pairs of the rows first, first + step, ....

    It consists of vector instructions, because the compiler cannot know that rows do not overlap. All
    rows stay in registers from the first pair to the last, because memory access takes most of the
    time.
    """

    def in_python(table, first, step):
        for i, j in pairs:
            a, b = table[first + i * step], table[first + j * step]
            a[:], b[:] = np.minimum(a, b), np.maximum(a, b)

    @intrinsic(in_python)
    def order(typing_context, table, first, step):
        def generate(context, builder, signature, arguments):
            data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            entry, places, rows = arguments[1], [], []
            for _ in range(1 + max(map(max, pairs))):
                start = builder.gep(data, [builder.mul(entry, entry.type(COLUMNS))])
                places.append(builder.bitcast(start, _ROW.as_pointer()))
                rows.append(builder.load(places[-1], align=8))
                entry = builder.add(entry, arguments[2])
            for i, j in pairs:
                rows[i], rows[j] = (
                    _extreme(builder, name, rows[i], rows[j]) for name in ("minnum", "maxnum")
                )
            for row, place in zip(rows, places, strict=True):
                builder.store(row, place, align=8)
            return context.get_dummy_value()

        return types.void(table, types.intp, types.intp), generate

    return order


def _extreme(builder, name, a, b):
    """Build the entry-wise minimum or maximum of two rows without NaN; 0 and -0 count as equal."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(_ROW, [_ROW, _ROW]), f"llvm.{name}.v{COLUMNS}f64"
    )
    return builder.call(function, [a, b], fastmath=("nnan", "nsz"))


_order_two = _network((0, 1))
_order_four = _network((0, 2), (1, 3), (0, 1), (2, 3))  # two rounds of the whole network
_sort_four = _network((0, 1), (2, 3), (0, 2), (1, 3), (1, 2))


@jit
def sort_columns(table):
    """Sort each of the `COLUMNS` columns of a contiguous table without NaN in place."""
    n, half = table.shape[0], np.int64(4)  # a literal would compile the called functions again
    _sort_fours(table)
    while half < n:
        _mirror(table, half)
        step = half // 2
        while step >= 2:
            _two_rounds(table, step // 2)
            step //= 4
        if step == 1:
            _round(table, step - 1, step)
        half *= 2


@jit
def _sort_fours(table):
    n = table.shape[0]
    whole = n - n % 4
    for block in range(0, whole, 4):
        _sort_four(table, block, 1)
    for _ in range(2):  # at most three rows
        for i in range(whole, n - 1):
            _order_two(table, i, 1)


@jit
def _mirror(table, half):
    """Move the smaller half of two sorted blocks to the front: compare last with first, and so on."""
    n = table.shape[0]
    for middle in range(half, n, 2 * half):
        for i in range(min(half, n - middle)):
            _order_two(table, middle - 1 - i, 2 * i + 1)


@jit
def _round(table, start, step):
    """Compare the rows from `start` on with those `step` further, in blocks of 2 step."""
    n = table.shape[0]
    for block in range(start, n - step, 2 * step):
        for i in range(block, min(block + step, n - step)):
            _order_two(table, i, step)


@jit
def _two_rounds(table, step):
    """Run the rounds with 2 step and with step."""
    n = table.shape[0]
    whole = n - n % (4 * step)
    for block in range(0, whole, 4 * step):
        for i in range(block, block + step):
            _order_four(table, i, step)
    _round(table, whole, 2 * step)
    _round(table, whole, step)
