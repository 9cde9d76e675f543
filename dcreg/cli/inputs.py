"""From files and the text of options to what the library takes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import dcreg
from dcreg.names import MODEL_DIM

if TYPE_CHECKING:  # loaded with the first file, not for --help
    import numpy as np

MAX_CARDINALITIES = 1000  # of one range of a sweep


def read_cloud(path: str, key: str | None, model: str) -> np.ndarray:
    """The points of a file, if they have the dimension of the model."""
    points = dcreg.read_points(path, key=key)
    needed, found = MODEL_DIM[model], points.shape[1]
    if found != needed:
        fitting = next(name for name, dim in MODEL_DIM.items() if dim == found)
        raise dcreg.InputError(
            f"{path}: points have {found} coordinates, but --model {model} needs {needed}; "
            f"use --model {fitting} or another file"
        )
    return points


def read_pairs(path: str | None, n_source: int) -> list[list[int]] | None:
    """The feasible pairs of a file; None without one: all."""
    return None if path is None else dcreg.read_candidates(path, n_source)


def parse_count(text: str) -> int | float:
    """`--n-inliers`: an integer is a count, anything with a decimal point a fraction."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' is not a number; give a count such as 40 or a fraction "
            "such as 0.8"
        ) from None


def parse_counts(text: str) -> list[int | float]:
    """`--n-inliers` of a sweep: numbers and ranges ``FROM:TO:STEP``, joined by commas."""
    counts: list[int | float] = []
    for part in filter(None, (part.strip() for part in text.split(","))):
        counts += _range(part) if ":" in part else [parse_count(part)]
    return counts


def _range(text: str) -> list[int | float]:
    first, last, *rest = ends = [parse_count(number) for number in text.split(":")]
    if len({type(number) for number in ends}) > 1:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' mixes counts and fractions; a fraction needs a decimal point, "
            "as in 0.3:1.0:0.1"
        )
    if not rest and isinstance(first, int):
        rest = [1]
    if len(rest) != 1 or not all(map(math.isfinite, ends)) or rest[0] <= 0 or first > last:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' is not a range FROM:TO:STEP with FROM <= TO and STEP > 0; "
            "give one such as 0.3:1.0:0.1 or 20:60:5"
        )
    step = rest[0]
    n_steps = math.floor((last - first) / step + 1e-9)  # 0.7 / 0.1 is a little less than 7
    if n_steps >= MAX_CARDINALITIES:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' names {n_steps + 1} cardinalities; choose a step that leaves at "
            f"most {MAX_CARDINALITIES}"
        )
    if isinstance(first, int):
        return [first + at * step for at in range(n_steps + 1)]
    return [round(first + at * step, 12) for at in range(n_steps + 1)]
