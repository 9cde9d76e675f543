"""The figure of evidence: intervals against the threshold, as strips of one scale per check."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from markupsafe import Markup

from reports.ledger.verdicts import Row

WIDE, HIGH = 100.0, 10.0  # of a strip; the page stretches it
_STRIP = Markup(
    f'<svg class="strip {{kind}}" viewBox="0 0 {WIDE:g} {HIGH:g}" preserveAspectRatio="none" '
    'role="img" aria-label="{label}">{claimed}<path class="interval" d="M{low:.1f} 5H{high:.1f}"/>'
    '<path class="value" d="M{value:.1f} 1.5V8.5"/></svg>'
)
_PAD = 0.06  # of the width, on both sides


def strips(rows: Sequence[Row]) -> list[Markup]:
    """Return a strip per row, all of the same scale: the interval, the figure, and the threshold.

    Ratios have a logarithmic scale. Ends of intervals that lie outside the scale are cut off.
    """
    if not rows:
        return []
    figures = [(row.shown.part.estimate.value, *row.shown.interval) for row in rows]
    thresholds = [float(t) for row in rows for t in _thresholds(row)]
    known = [x for figure in figures for x in figure if math.isfinite(x)] + thresholds
    is_ratio = "ratio" in rows[0].figure or " / " in rows[0].figure
    place = _scale(known, log=is_ratio and min(known) > 0)
    return [_strip(row, figure, place) for row, figure in zip(rows, figures, strict=True)]


def _thresholds(row: Row) -> list[float]:
    (threshold,) = row.shown.part.claimed.values()
    return list(np.atleast_1d(threshold))


def _scale(known: Sequence[float], *, log: bool) -> Callable[[float], float]:
    """Return the place of a value on a strip, between 0 and `WIDE`."""
    ends = [math.log10(x) for x in known] if log else list(known)
    low, high = min(ends), max(ends)
    extent = (high - low) or 1.0

    def place(value: float) -> float:
        if log:
            value = math.log10(value) if value > 0 else -math.inf
        share = _PAD + (1 - 2 * _PAD) * (value - low) / extent
        return WIDE * min(1.0, max(0.0, share))

    return place


def _strip(row: Row, figure: tuple[float, float, float], place: Callable[[float], float]) -> Markup:
    value, low, high = (place(x) for x in figure)
    claimed = "".join(
        f'<path class="threshold" d="M{place(t):.1f} 0V{HIGH:g}"/>' for t in _thresholds(row)
    )
    label = f"{row.names}, {row.group}: {row.value}, {row.verdict}"
    kind = row.verdict.replace(" ", "-")
    return _STRIP.format(
        kind=kind,
        label=label,
        claimed=Markup(claimed),
        low=low,
        high=max(high, low + 0.6),
        value=value,
    )
