"""Find the datasets: every folder of ``data/`` with a ``card.yaml``.

Further folders of datasets are named in the environment variable ``DCREG_DATA_PATH``. Installed packages
add datasets by the entry points of the group ``dcreg.datasets`` (`dcreg.plugins`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import yaml
from pydantic import ValidationError

from data.contract import Card, DataError, Dataset, UnknownNameError
from data.loaders import STOCK
from data.parameters import place_of, shown
from dcreg.plugins import Plugin, PluginError, files_under, import_file, plugins
from dcreg.plugins import files_of as files_of_plugin
from dcreg.problem import suggestion

HERE = Path(__file__).parent
GROUP = "dcreg.datasets"  # of entry points
SEARCH_PATH = "DCREG_DATA_PATH"
_EXAMPLE = "correct it, see data/embedded/card.yaml"
NOT_YAML = (yaml.YAMLError, ValueError, AttributeError, RecursionError)  # what PyYAML raises


def read_card(path: Path, name: str = "") -> Card:
    """Read and validate the card of a dataset, which has the name of its folder by default."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise DataError(f"{path}: must be a mapping of keys to values; {_EXAMPLE}")
        card = Card.model_validate(content).placed(path)
    except ValidationError as error:
        wrong = error.errors()[0]
        key = ".".join(map(str, wrong["loc"])) or "card"
        text = wrong["msg"][0].lower() + wrong["msg"][1:]
        raise DataError(f"{path}: {key}: {text}; {_EXAMPLE}") from error
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; {_EXAMPLE}") from error
    except NOT_YAML as error:
        raise DataError(f"{path}: not valid YAML: {error}; {_EXAMPLE}") from error
    if card.name != (name or path.parent.name):
        owner = f"the entry point {name!r}" if name else "its folder"
        raise DataError(f"{path}: name {card.name!r} differs from {owner}; make them equal")
    return card


def _build(card: Card, package: str = "") -> Dataset:
    if card.loader == "own":
        path = card.folder / "loader.py"
        try:
            loader: type[Dataset] = _own_module(path, package).Loader
        except Exception as error:  # what the code of others raises
            raise DataError(
                f"{shown(path)}: {error}; with loader: own, define the class Loader there"
            ) from error
    elif card.loader in STOCK:
        loader = STOCK[card.loader]
    else:
        raise DataError(
            f"{place_of(card)}: loader {card.loader!r} is unknown; use one of {['own', *STOCK]}"
        )
    return loader(card)


def _own_module(path: Path, package: str) -> ModuleType:
    """Import the ``loader.py`` of a dataset: of a package, of this folder, or of any other."""
    if package or path.parents[1] == HERE:
        return import_module(f"{package or f'data.{path.parent.name}'}.loader")
    return import_file(path)


class Found(Mapping[str, Dataset]):
    """Datasets by name; a card is read on first access, so a wrong one does not affect others.

    Parameters
    ----------
    *roots : Path
        Folders that contain folders of datasets.
    added : sequence of Plugin
        Datasets of installed packages.
    """

    def __init__(self, *roots: Path, added: Sequence[Plugin] = ()) -> None:
        self._owners: dict[str, list[Path | Plugin]] = {}
        for root in roots:
            for path in sorted(root.glob("*/card.yaml")):
                self._owners.setdefault(path.parent.name, []).append(path)
        for plugin in added:
            self._owners.setdefault(plugin.name, []).append(plugin)
        self._built: dict[str, Dataset] = {}

    def __getitem__(self, name: str) -> Dataset:
        if name not in self._built:
            self._built[name] = self._made(name, self._owners[name])
        return self._built[name]

    def _made(self, name: str, owners: list[Path | Plugin]) -> Dataset:
        if len(owners) > 1:
            parties = [
                shown(owner.parent) if isinstance(owner, Path) else owner.origin for owner in owners
            ]
            raise DataError(
                f"dataset {name!r} is defined twice: by {' and by '.join(parties)}; rename one of them"
            )
        (owner,) = owners
        if isinstance(owner, Path):
            return _build(read_card(owner))
        try:
            return _build(read_card(owner.files / "card.yaml", name), owner.module)
        except (DataError, PluginError) as error:
            raise DataError(f"{owner.origin}: {error}") from error

    def __contains__(self, name: object) -> bool:
        return name in self._owners

    def __iter__(self) -> Iterator[str]:
        return iter(self._owners)

    def __len__(self) -> int:
        return len(self._owners)


def datasets() -> Found:
    """Return all datasets by name, without fetching files.

    Raises
    ------
    DataError
        An entry of the environment variable is not a folder.
    """
    return _datasets(os.environ.get(SEARCH_PATH, ""), tuple(plugins(GROUP)))


@cache
def _datasets(search_path: str, added: tuple[Plugin, ...]) -> Found:
    extra = [Path(entry).expanduser().resolve() for entry in search_path.split(os.pathsep) if entry]
    for folder in extra:
        if not folder.is_dir():
            raise DataError(f"{SEARCH_PATH}: {folder} is not a folder; correct it")
    return Found(*dict.fromkeys([HERE, *extra]), added=added)


def dataset(name: str) -> Dataset:
    """Return the dataset of this name, or raise an error that lists the known ones."""
    found = datasets()
    if name not in found:
        raise UnknownNameError(f"no dataset {name!r}{suggestion(name, found)}")
    return found[name]


def files_of(name: str) -> list[Path]:
    """Return the files that define a dataset: those of its folder, or of the package that adds it."""
    card = dataset(name).card
    added = [plugin for plugin in plugins(GROUP) if plugin.name == name]
    if added:
        return files_of_plugin(added[0])
    return files_under(card.folder)
