"""Find the datasets: every folder of ``data/`` with a ``card.yaml``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path

import yaml
from pydantic import ValidationError

from data.contract import Card, DataError, Dataset, UnknownNameError
from data.loaders import STOCK
from dcreg.problem import suggestion

HERE = Path(__file__).parent
_EXAMPLE = "correct it, see data/embedded/card.yaml"
NOT_YAML = (yaml.YAMLError, ValueError, AttributeError, RecursionError)  # what PyYAML raises


def read_card(path: Path) -> Card:
    """Read and validate one card."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise DataError(f"{path}: must be a mapping of keys to values; {_EXAMPLE}")
        card = Card.model_validate(content)
    except ValidationError as error:
        wrong = error.errors()[0]
        key = ".".join(map(str, wrong["loc"])) or "card"
        text = wrong["msg"][0].lower() + wrong["msg"][1:]
        raise DataError(f"{path}: {key}: {text}; {_EXAMPLE}") from error
    except NOT_YAML as error:
        raise DataError(f"{path}: not valid YAML: {error}; {_EXAMPLE}") from error
    if card.name != path.parent.name:
        raise DataError(f"{path}: name {card.name!r} differs from its folder; make them equal")
    return card


def _build(card: Card) -> Dataset:
    if card.loader == "own":
        module = f"data.{card.name}.loader"
        try:
            loader: type[Dataset] = import_module(module).Loader
        except (ImportError, SyntaxError, AttributeError) as error:
            raise DataError(
                f"data/{card.name}/loader.py: {error}; with loader: own, define the class Loader there"
            ) from error
    elif card.loader in STOCK:
        loader = STOCK[card.loader]
    else:
        raise DataError(
            f"data/{card.name}/card.yaml: loader {card.loader!r} is unknown; "
            f"use one of {['own', *STOCK]}"
        )
    return loader(card)


class Found(Mapping[str, Dataset]):
    """Datasets by name; a card is read on first access, so a wrong one does not affect others."""

    def __init__(self, root: Path) -> None:
        self._cards = {path.parent.name: path for path in sorted(root.glob("*/card.yaml"))}
        self._built: dict[str, Dataset] = {}

    def __getitem__(self, name: str) -> Dataset:
        if name not in self._built:
            self._built[name] = _build(read_card(self._cards[name]))
        return self._built[name]

    def __contains__(self, name: object) -> bool:
        return name in self._cards

    def __iter__(self) -> Iterator[str]:
        return iter(self._cards)

    def __len__(self) -> int:
        return len(self._cards)


@cache
def datasets() -> Found:
    """Return all datasets by name, without fetching files."""
    return Found(HERE)


def dataset(name: str) -> Dataset:
    """Return the dataset of this name, or raise an error that lists the known ones."""
    found = datasets()
    if name not in found:
        raise UnknownNameError(f"no dataset {name!r}{suggestion(name, found)}")
    return found[name]
