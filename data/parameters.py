"""The parameters of a dataset's card, checked for the loader that takes them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data.contract import Card, DataError, File
from dcreg.problem import suggestion

CHECKOUT = Path(__file__).resolve().parents[1]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, strict=True)]
Points = Annotated[int, Field(ge=3, strict=True)]  # of a cloud


class Parameters(BaseModel):
    """The parameters of one loader: fields without a default are required, others are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


P = TypeVar("P", bound=Parameters)


def place_of(card: Card) -> str:
    """Return the path of a card for messages."""
    return shown(card.path)


def shown(path: Path) -> str:
    """Return a path relative to the checkout, if it is inside."""
    return str(path.relative_to(CHECKOUT) if path.is_relative_to(CHECKOUT) else path)


def parameters_of(card: Card, kind: type[P]) -> P:
    """Check the card's parameters for a loader.

    Raises
    ------
    DataError
        For the first parameter that is missing, unknown or invalid.
    """
    try:
        return kind.model_validate(card.parameters)
    except ValidationError as error:
        problem = error.errors()[0]
        known = kind.model_fields if len(problem["loc"]) == 1 else ()
        problem["loc"] = ("parameters", *problem["loc"])
        raise DataError(f"{place_of(card)}: {explain(problem, lambda _: known)}") from error


def file_of(card: Card, path: str, parameter: str) -> File:
    """Return the file with this mirror path, which `parameter` names."""
    known = [file.path for file in card.files]
    if path not in known:
        raise DataError(
            f"{place_of(card)}: parameters.{parameter}: {path!r} is not among the files of the card"
            f"{suggestion(path, known)}"
        )
    return card.file(path)


def key_path(location: Sequence[str | int]) -> str:
    """Return a location as text, such as ``datasets[0].tests``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return "".join(parts).removeprefix(".")


def explain(problem: Any, keys_at: Callable[[Sequence[str | int]], Iterable[str]]) -> str:
    """Describe one pydantic problem as ``key.path: what is wrong; remedy``.

    `keys_at` returns the keys that are known at a location.
    """
    location = problem["loc"]
    key = key_path(location)
    match problem["type"]:
        case "extra_forbidden":
            return f"{key}: unknown key{suggestion(str(location[-1]), keys_at(location[:-1]))}"
        case "missing":
            return f"{key}: missing; add it"
        case "value_error":
            return f"{key}: {problem['ctx']['error']}".removeprefix(": ")
    return f"{key}: {problem['input']!r}; {problem['msg'][0].lower()}{problem['msg'][1:]}"
