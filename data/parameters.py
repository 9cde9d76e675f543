"""The parameters of a data set's card, checked for the loader that takes them."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data.contract import Card, DataError, File
from dcreg.problem import suggestion

Length = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, strict=True)]
Points = Annotated[int, Field(ge=3, strict=True)]  # of a cloud


class Parameters(BaseModel):
    """What one loader takes: fields without a default are required, others are unknown."""

    model_config = ConfigDict(extra="forbid", frozen=True)


P = TypeVar("P", bound=Parameters)


def place_of(card: Card) -> str:
    """The file of a card, as messages name it."""
    return f"data/{card.name}/card.yaml"


def parameters_of(card: Card, kind: type[P]) -> P:
    """The card's parameters as those of a loader.

    Raises
    ------
    DataError
        For the first one that is missing, unknown, or no value that it can have.
    """
    try:
        return kind.model_validate(card.parameters)
    except ValidationError as error:
        raise DataError(f"{place_of(card)}: {_explain(card, kind, error.errors()[0])}") from error


def file_of(card: Card, path: str, parameter: str) -> File:
    """The file with this mirror path, which `parameter` names."""
    known = [file.path for file in card.files]
    if path not in known:
        raise DataError(
            f"{place_of(card)}: parameters.{parameter}: {path!r} is none of the card's files"
            f"{suggestion(path, known)}"
        )
    return card.file(path)


def _explain(card: Card, kind: type[Parameters], problem: Any) -> str:
    key = ".".join(map(str, ("parameters", *problem["loc"])))
    if problem["type"] == "missing":
        return f"{key}: missing; add it, as the loader {card.loader} takes {', '.join(kind.model_fields)}"
    if problem["type"] == "extra_forbidden":
        known = kind.model_fields if len(problem["loc"]) == 1 else ()
        return f"{key}: unknown{suggestion(str(problem['loc'][-1]), known)}"
    if problem["type"] == "value_error":
        return f"{key}: {problem['ctx']['error']}"
    return f"{key}: {problem['input']!r}; {problem['msg'][0].lower()}{problem['msg'][1:]}"
