"""A part of an experiment's config: known keys only, and no flags instead of numbers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, model_validator


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _has_no_flags(cls, values: Any) -> Any:
        for key, value in values.items() if isinstance(values, dict) else ():
            field = cls.model_fields.get(key)
            if field and (part_of(field.annotation) or Any in get_args(field.annotation)):
                continue  # parts check themselves, and a method may take flags
            for place, flag in _flags(key, value):  # which pydantic takes for 0 or 1
                raise ValueError(f"{place} is {str(flag).lower()}; give a number or text")
        return values


def part_of(annotation: Any) -> Any:
    """Return the `Part` inside an annotation such as ``Annotated[list[Part], ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return annotation
    return next((part for inner in get_args(annotation) if (part := part_of(inner))), None)


def _flags(place: str, value: Any) -> Iterator[tuple[str, bool]]:
    """Yield all ``true`` and ``false`` in the value, at any depth, with their places."""
    if isinstance(value, bool):
        yield place, value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _flags(f"{place}.{key}", inner)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _flags(f"{place}[{index}]", inner)
