"""Compiled tests of pair features; see `baselines.gots.features`."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit


@jit
def matched_pairs(source, pairs, listed, centre, half, eps, bar, features, spans, boxes, norms):
    """Return the listed source pairs that some t of the cube may match, and a bound on their number.

    The count stops if it cannot exceed `bar`; the bound is still valid. With ``half = 0`` it is the exact
    count at the centre.
    """
    n = len(source)
    low, high = np.empty(n), np.empty(n)
    alone = np.empty(n, np.bool_)
    for i in range(n):
        low[i], high[i] = _norm_interval(source[i], centre, half)
        low[i] -= eps
        high[i] += eps
        # A point without a target norm within reach is in no matched pair.
        place = np.searchsorted(norms, low[i])
        alone[i] = place == len(norms) or norms[place] > high[i]
    kept = np.empty(len(listed), np.int32)
    n_kept = 0
    for position in range(len(listed)):
        p = listed[position]
        i, k = int(pairs[p, 0]), int(pairs[p, 1])
        if not (alone[i] or alone[k]) and _holds(
            low[i], high[i], low[k], high[k], pairs[p, 2] - 2 * eps, pairs[p, 2] + 2 * eps,
            features, spans, boxes,
        ):  # fmt: skip
            kept[n_kept] = p
            n_kept += 1
        most = n_kept + len(listed) - position - 1
        if most <= bar:
            return kept[:0], most
    return kept[:n_kept], n_kept


@jit
def _norm_interval(x, centre, half):
    """Return the range of |x + t| over the cube, widened by rounding."""
    least = largest = 0.0
    for axis in range(3):
        a = abs(x[axis] + centre[axis])
        least += max(a - half, 0.0) ** 2
        largest += (a + half) ** 2
    return np.sqrt(least) - 1e-12, np.sqrt(largest) + 1e-12


@jit
def _holds(low_a, high_a, low_b, high_b, low_c, high_c, features, spans, boxes):
    """Return whether a target feature lies in the box."""
    stack = np.empty(64, np.int64)
    stack[0] = 0
    size = 1
    while size > 0:
        size -= 1
        node = stack[size]
        box = boxes[node]
        if (
            box[0] > high_a or box[3] < low_a or box[1] > high_b or box[4] < low_b
            or box[2] > high_c or box[5] < low_c
        ):  # fmt: skip
            continue
        if (
            box[0] >= low_a and box[3] <= high_a and box[1] >= low_b and box[4] <= high_b
            and box[2] >= low_c and box[5] <= high_c
        ):  # fmt: skip
            return True
        if 2 * node + 2 < len(boxes):
            stack[size], stack[size + 1] = 2 * node + 1, 2 * node + 2
            size += 2
            continue
        for f in range(spans[node, 0], spans[node, 1]):
            a, b, c = features[f, 0], features[f, 1], features[f, 2]
            if low_a <= a <= high_a and low_b <= b <= high_b and low_c <= c <= high_c:
                return True
    return False
