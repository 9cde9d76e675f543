"""Finds every dataset: a folder of ``data/`` that holds a ``card.yaml``."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path

import yaml
from pydantic import ValidationError

from data.contract import Card, DataError, Dataset, UnknownNameError
from data.loaders import STOCK
from dcreg.problem import suggestion

HERE = Path(__file__).parent


def read_card(path: Path) -> Card:
    """Read and validate one card."""
    try:
        card = Card.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (ValidationError, yaml.YAMLError, AttributeError) as error:
        raise DataError(f"{path}: not a valid card. {error}") from error
    if card.name != path.parent.name:
        raise DataError(f"{path}: name {card.name!r} differs from its folder; make them equal")
    return card


def _build(card: Card) -> Dataset:
    if card.loader == "own":
        loader: type[Dataset] = import_module(f"data.{card.name}.loader").Loader
    elif card.loader in STOCK:
        loader = STOCK[card.loader]
    else:
        raise DataError(
            f"data/{card.name}/card.yaml: loader {card.loader!r} is unknown; "
            f"use one of {['own', *STOCK]}"
        )
    return loader(card)


@cache
def datasets() -> dict[str, Dataset]:
    """All datasets by name. Reads cards only; fetches nothing."""
    cards = (read_card(path) for path in sorted(HERE.glob("*/card.yaml")))
    return {card.name: _build(card) for card in cards}


def dataset(name: str) -> Dataset:
    """The dataset of this name, or an error that lists those there are."""
    found = datasets()
    if name not in found:
        raise UnknownNameError(f"no dataset {name!r}{suggestion(name, found)}")
    return found[name]
