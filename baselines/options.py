"""Check the options of a method against the parameters and ranges of its card."""

from __future__ import annotations

from typing import Any

from baselines.contract import Card
from dcreg.problem.problem import suggestion


def check_option(card: Card, option: str, value: Any) -> str | None:
    """Return what is wrong with the value of an option, or None."""
    if option not in card.parameters:
        return f"unknown option {option!r}{suggestion(option, card.parameters)}"
    default, admitted = card.parameters[option], card.ranges.get(option)
    if value is None and (default is None or (admitted is not None and admitted.or_null)):
        return None
    example = 1.0 if default is None and admitted is not None else default
    if example is None and isinstance(value, list | dict):
        return f"option {option} = {value!r} is a {type(value).__name__}; give one value"
    if example is None or (value is None and isinstance(example, str)):
        return None  # checked by the method
    if not _is_like(value, example):
        return (
            f"option {option} = {value!r} is a {type(value).__name__}; "
            f"give a {type(example).__name__} such as "
            + (f"{example!r}" if default is None else f"the default {default!r}")
        )
    if admitted is not None and not admitted.admits(value):
        return f"option {option} = {value!r}; give {admitted}"
    return None


def _is_like(value: Any, example: Any) -> bool:
    """Return whether a value has the type of another; an int is accepted as a float."""
    if isinstance(example, list):
        return isinstance(value, list) and all(
            _is_like(entry, first) for first in example[:1] for entry in value
        )
    # A bool is an int in Python, but "iterations: true" is a mistake.
    if isinstance(value, bool) or isinstance(example, bool):
        return isinstance(value, bool) and isinstance(example, bool)
    return isinstance(value, (int, float) if isinstance(example, float) else type(example))
