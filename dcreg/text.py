"""Plain text in columns, for printed results."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from decimal import ROUND_FLOOR, Context

_ROUNDING = 1e-6  # in thousandths: a computed 99 % is not 98.9 %


def count(number: int, thing: str, things: str | None = None) -> str:
    """Return a number and its noun, of which the plural may be irregular.

    Examples
    --------
    >>> count(1, "node"), count(2, "node"), count(2, "box", "boxes")
    ('1 node', '2 nodes', '2 boxes')
    """
    return f"{number} {thing if number == 1 else things or thing + 's'}"


def percent(share: float) -> str:
    """Return a share in per cent, rounded down: only a whole is 100 %.

    Examples
    --------
    >>> percent(0.99996), percent(1.0), percent(0.99 - 1e-12)
    ('99.9 %', '100 %', '99.0 %')
    """
    return "100 %" if share >= 1.0 else f"{math.floor(1000.0 * share + _ROUNDING) / 10.0:.1f} %"


def rounded_down(value: float, digits: int) -> str:
    """Return a lower bound with some significant digits; it remains a lower bound.

    Examples
    --------
    >>> rounded_down(0.0871298, 4), rounded_down(0.25, 4)
    ('0.08712', '0.25')
    """
    shown = Context(prec=digits, rounding=ROUND_FLOOR).create_decimal(value)
    return f"{float(shown):.{digits}g}"


def listing(entries: Sequence[tuple[str, str]]) -> str:
    """Return names and values in two columns; a value may have several lines.

    Examples
    --------
    >>> print(listing([("status", "optimal"), ("pose", "1 0\\n0 1")]))
    status  optimal
    pose    1 0
            0 1
    """
    width = max(len(name) for name, _ in entries) + 2
    lines = []
    for name, text in entries:
        first, *rest = text.split("\n")
        lines += [f"{name:<{width}}{first}", *(" " * width + line for line in rest)]
    return "\n".join(lines)


def pose(matrix: Iterable[Sequence[float]]) -> str:
    """Return the rows of a pose, with more digits if the coordinates are large, as those of maps are.

    Otherwise rounding would move the points by more than their residuals.

    Examples
    --------
    >>> print(pose([[1.0, 0.0, 0.25], [0.0, 1.0, 4500000.0625], [0.0, 0.0, 1.0]]))
                     1                  0               0.25
                     0                  1       4500000.0625
                     0                  0                  1
    """
    rows = [list(row) for row in matrix]
    farthest = max(abs(row[-1]) for row in rows)
    extra = math.ceil(math.log10(farthest)) - 3 if math.isfinite(farthest) else 0
    digits = min(max(8, 8 + extra), 17)
    return "\n".join(" ".join(f"{x:>{digits + 6}.{digits}g}" for x in row) for row in rows)


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[str] = ()) -> str:
    """Return rows under headings, right-aligned except the columns named in `left`.

    Examples
    --------
    >>> print(table(["pairs", "status"], [["6", "optimal"], ["12", "time_limit"]], ["status"]))
    pairs  status
        6  optimal
       12  time_limit
    """
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    return "\n".join(
        "  ".join(
            f"{cell:<{width}}" if heading in left else f"{cell:>{width}}"
            for cell, width, heading in zip(row, widths, headings, strict=True)
        ).rstrip()
        for row in [headings, *rows]
    )
