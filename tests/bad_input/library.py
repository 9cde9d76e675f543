"""Arguments of the library's own functions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

import dcreg
from tests.bad_input.case import A2, A3, B2, B3, Case
from tests.problems import register as solve

NAN = A2.copy()
NAN[3, 1] = np.nan
CHANGES: dict[str, tuple[dict[str, Any], str, str]] = {
    "source of words": ({"source": [["a", "b"]]}, "source: not an array of real numbers", "'a'"),
    "source of rows of all lengths": ({"source": [[1, 2], [3]]}, "source: not an array", "shape"),
    "source of one axis": ({"source": np.zeros(4)}, "source: shape (4,)", "one point per row"),
    "source in 3D": ({"source": A3}, "source: shape (8, 3)", "choose another model"),
    "target transposed": ({"target": B2.T}, "target: shape (2, 8)", "one point per row"),
    "target without points": ({"target": np.zeros((0, 2))}, "target: no points", "give at least"),
    "nan": ({"source": NAN}, "source: 1 point(s) with NaN or infinity, the first in row 3", "remove"),
    "huge coordinates": ({"target": 1e200 * B2}, "target: [", "in a larger unit"),
    "masked": ({"source": np.ma.masked_greater(A2, 0)}, "source: not an array of real", "masked"),
    "complex": ({"target": B2 + 1j}, "target: not an array of real", "masked or complex"),
    "list of models": ({"model": ["rigid3d"]}, "model: ['rigid3d'] is unknown", "known: rigid3d"),
    "model": ({"model": "affine"}, "model: 'affine' is unknown", "known: rigid3d"),
    "pairs of words": ({"n_inliers": "half"}, "n_inliers: 'half'", "give a count, a fraction"),
    "no pairs": ({"n_inliers": None}, "n_inliers: None", "give a count or a fraction"),
    "pairs of truth": ({"n_inliers": True}, "n_inliers: True", "give a count or a fraction"),
    "0 pairs": ({"n_inliers": 0}, "n_inliers: 0", "an integer between 1 and 8"),
    "9 pairs": ({"n_inliers": 9}, "n_inliers: 9", "an integer between 1 and 8"),
    "2.0 pairs": ({"n_inliers": 2.0}, "n_inliers: the fraction 2.0", "an integer between 1 and 8"),
    "nan pairs": ({"n_inliers": np.nan}, "n_inliers: the fraction nan", "between 1 and 8"),
    "mode": ({"mode": "fast"}, "mode: 'fast' is unknown", "known: "),
    "bound": ({"bound": "fast"}, "bound: 'fast' is unknown", "known: "),
    "start box": ({"start_box": "small"}, "start_box: 'small' is unknown", "known: radius, stationary"),
    "scale range": ({"scale_range": (2, 1)}, "scale_range: (2.0, 1.0)", "0 < low <= high"),
    "scale of words": ({"scale_range": "wide"}, "scale_range: 'wide'", "pair of numbers"),
    "digits as scales": ({"scale_range": "11"}, "scale_range: '11'", "pair of numbers"),
    "a scale of words": ({"scale_range": (0.5, 1.5, "x")}, "scale_range: (0.5", "pair of numbers"),
    "three scales": ({"scale_range": (1, 2, 3)}, "scale_range: (1, 2, 3)", "pair of numbers"),
    "rel_gap": ({"rel_gap": -1}, "rel_gap: -1", "give 0 or a positive number"),
    "rel_gap of words": ({"rel_gap": "small"}, "rel_gap: 'small'", "give 0 or a positive number"),
    "rel_gap in per cent": ({"rel_gap": 1}, "rel_gap: 1 is not below 1", "such as 0.01"),
    "no rel_gap": ({"rel_gap": None}, "rel_gap: None", "give 0 or a positive number"),
    "abs_gap": ({"abs_gap": -1}, "abs_gap: -1", "give 0 or a positive number"),
    "abs_gap of words": ({"abs_gap": "small"}, "abs_gap: 'small'", "give 0 or a positive number"),
    "tol": ({"tol": -1}, "tol: -1", "give a length"),
    "two tolerances": ({"tol": 1, "abs_gap": 1}, "tol: 1, and abs_gap: 1", "give one of them"),
    "time limit": ({"time_limit": 0}, "time_limit: 0", "give a positive number"),
    "time limit of words": ({"time_limit": "1h"}, "time_limit: '1h'", "give a positive number"),
    "node limit": ({"node_limit": 0}, "node_limit: 0", "give a positive number"),
    "memory limit": ({"memory_limit_mb": -1}, "memory_limit_mb: -1", "give a positive number"),
    "threads": ({"threads": 0}, "threads: 0", "give a positive number"),
    "threads without end": ({"threads": 10**9}, "threads: 1000000000 threads", "give at most"),
    "mask of another shape": ({"candidates": np.ones((3, 3), bool)}, "candidates: mask of shape (3, 3)",
                              "need (8, 8)"),
    "too few lists": ({"candidates": [[0]]}, "candidates: 1 index lists", "give one each"),
    "a number for pairs": ({"candidates": 3}, "candidates: neither", "a boolean mask"),
    "pairs beyond": ({"candidates": [[9]] * 8}, "candidates: 9 for source point 0", "from 0 to 7"),
    "huge pairs": ({"candidates": [[1e30]] * 8}, "candidates: 1e+30", "from 0 to 7"),
    "no feasible pairs": ({"candidates": np.zeros((8, 8), bool)}, "candidates: at most 0", "allow more"),
}  # fmt: skip


def _cases() -> Iterator[Case]:
    good: dict[str, Any] = {"source": A2, "target": B2, "n_inliers": 6, "model": "similarity2d"}
    for name, (change, *words) in CHANGES.items():
        options = good | {"time_limit": 5} | change
        source, target = options.pop("source"), options.pop("target")
        yield Case("library", name, partial(solve, source, target, **options), words)
    swept: Callable[..., object] = partial(dcreg.sweep, A2, B2, model="similarity2d")
    for name, counts, words in (
        ("sweep of a number", 5, ["n_inliers: 5 is not a list", "give several"]),
        ("sweep of text", "4:8", ["n_inliers: '4:8' is not a list", "give several"]),
        ("sweep of nothing", [], ["n_inliers: the list is empty", "give at least one"]),
        ("sweep beyond", [4, 9], ["n_inliers: 9", "between 1 and 8"]),
    ):
        yield Case("library", name, partial(swept, counts), words)
    found = partial(dcreg.register, A2, B2, n_inliers=6, model="similarity2d", tol=0.5)
    yield Case("library", "certificate that was not kept",
               lambda: found().write_certificate("c.npz"),
               ["certificate: the result has none", "certificate=True"])  # fmt: skip
    yield Case("library", "plot as an image",
               lambda: dcreg.plot_registration(A2, B2, found(), "o.png"),
               ["o.png", "'.png'", "use .html"])  # fmt: skip
    pairs = np.column_stack([np.arange(8)] * 2)
    for name, value in (("inlier_distance", "0.1"), ("inlier_distance", None), ("certify", "no")):
        given = {"inlier_distance": 0.1, name: value}
        yield Case("library", f"{name} {value!r}",
                   partial(dcreg.register_matches, A3, B3, pairs, **given),
                   [f"{name}: {value!r} is not a"])  # fmt: skip
    yield Case("library", "scale in 3D",
               partial(dcreg.register, A3, B3, n_inliers=6, model="rigid3d", scale_range=(1, 2)),
               ["scale_range: (1.0, 2.0)", "leave it out"])  # fmt: skip


CASES = list(_cases())
