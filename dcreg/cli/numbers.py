"""Numbers of the command line, from text."""

from __future__ import annotations

import math

import typer

import dcreg
from dcreg.names import AUTO

MAX_CARDINALITIES = 1000  # of one range of a sweep


# Typer's own conversions name the option but not the value.
def number(text: str) -> float:
    """Return a number, or raise an error that shows the text."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a number; give one such as 0.5") from None


def whole_number(text: str) -> int:
    """Return a whole number, or raise an error that shows the text."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a whole number; give one such as 4") from None


def parse_count_or_auto(text: str) -> int | float | str:
    """Return `--n-inliers` of a registration: a number as in `parse_count`, or ``auto``."""
    return AUTO if text == AUTO else parse_count(text)


def parse_count(text: str) -> int | float:
    """Return `--n-inliers`: an integer is a number of pairs, a decimal point makes it a fraction."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    raise dcreg.InputError(
        f"--n-inliers: '{text}' is not a number; give a count such as 40 or a fraction such as 0.8"
    )


def parse_counts(text: str) -> list[int | float]:
    """Return `--n-inliers` of a sweep: numbers and ranges ``FROM:TO:STEP``, separated by commas."""
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
    n_steps = math.floor((last - first) / step + 1e-9)  # 0.7 / 0.1 is slightly less than 7
    if n_steps >= MAX_CARDINALITIES:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' is a range of {n_steps + 1} numbers; choose a step that leaves at "
            f"most {MAX_CARDINALITIES}"
        )
    return [round(first + at * step, 12) for at in range(n_steps + 1)]


def parse_axis(text: str) -> list[float]:
    """Return `--axis`: three numbers, separated by commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise dcreg.InputError(
            f"--axis: '{text}' is not a direction; give three numbers such as 0,0,1"
        ) from None
