"""Read the content of a config: its quick part, and the shared lists of methods that it names."""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from dcreg.problem import suggestion
from workflows import UserError, shown

QUICK = "-quick"  # ends the name of the quick part of an experiment
EMBEDDED = "-embedded"  # ends the name of an experiment on embedded shapes (`workflows.stand_ins`)
TIER = re.compile(
    r"(?P<whole>.+)-(?P<points>[1-9][0-9]*)"
)  # the name of a tier: fewer points per shape
MOST_PARTS = 100_000  # of a config
NOT_YAML = (yaml.YAMLError, ValueError, AttributeError, RecursionError)  # what PyYAML raises
METHOD_LISTS = "methods"  # folder of shared lists, next to the configs
OWN_LISTS = Path(__file__).parent / "configs" / METHOD_LISTS


class ConfigError(UserError):
    """The config cannot be used; the message names file, key, value and remedy."""


def read(path: Path, quick: bool = False, n_points: int | None = None) -> dict[str, Any]:
    """Return the content of a config, or of its quick part, with shared lists expanded.

    With `n_points` it is a tier: every dataset has this number of points per shape, and name and title
    say so.

    The key ``quick`` replaces keys of the config: ``limits`` key by key, all others as a whole. A text
    among ``methods`` is the name of a list in ``methods/`` next to the config, or in
    ``workflows/configs/methods``.

    Raises
    ------
    ConfigError
        The file cannot be read, has no quick part, or names an unknown list.
    """
    content = _yaml(path)
    if not isinstance(content, dict):
        raise ConfigError(f"{shown(path)}: must be a mapping of keys to values")
    instead = content.pop("quick", None)
    if n_points is not None:
        for settings in (content, instead) if isinstance(instead, dict) else (content,):
            for entry in settings.get("datasets") or ():
                if isinstance(entry, dict):
                    entry["n_points"] = n_points
        content["name"] = f"{content.get('name')}-{n_points}"
        content["title"] = f"{content.get('title', '')}, {n_points} points"
    if quick:
        if not isinstance(instead, dict):
            raise ConfigError(f"{shown(path)}: has no quick part; add the key quick, a mapping")
        whole, part = content.get("limits"), instead.get("limits")
        if isinstance(whole, dict) and isinstance(part, dict):
            instead["limits"] = {**whole, **part}
        name, title = f"{content.get('name')}{QUICK}", f"{content.get('title', '')}, quick part"
        content = {**content, **instead, "name": name, "title": title}
    if isinstance(content.get("methods"), list):
        content["methods"] = [
            method for entry in content["methods"] for method in _methods(entry, path)
        ]
    return content


def has_quick_part(path: Path) -> bool:
    """Whether a readable config has the key ``quick``."""
    return "quick" in _yaml(path)


def _methods(entry: Any, path: Path) -> list[Any]:
    """Return an entry of ``methods``, or the shared list of that name."""
    if not isinstance(entry, str):
        return [entry]
    folders = dict.fromkeys((OWN_LISTS, path.parent / METHOD_LISTS))  # the last one wins
    lists = {file.stem: file for folder in folders for file in sorted(folder.glob("*.yaml"))}
    if entry not in lists:
        raise ConfigError(
            f"{shown(path)}: methods: no list {entry!r} in {' or '.join(map(shown, folders))}"
            f"{suggestion(entry, lists)}"
        )
    listed = _yaml(lists[entry])
    if not isinstance(listed, list):
        raise ConfigError(f"{shown(lists[entry])}: must be a list of methods")
    return listed


def _yaml(path: Path) -> Any:
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _StrictLoader)
    except NOT_YAML as error:
        raise ConfigError(
            f"{shown(path)}: not valid YAML: {error}; correct it, see workflows/configs/demo.yaml"
        ) from error
    except OSError as error:
        raise ConfigError(f"{shown(path)}: {error.strerror}; make the file readable") from error


def _size(node: Any, known: dict[int, int]) -> int:
    """Return the number of entries with all aliases written out."""
    if not isinstance(node.value, list):
        return 1
    if id(node) not in known:
        parts = (
            part
            for entry in node.value
            for part in (entry if isinstance(entry, tuple) else [entry])
        )
        known[id(node)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(node)]


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a duplicate key is an error, and an alias of what contains it."""

    def construct_document(self, node: Any) -> Any:
        self.deep_construct = (
            True  # otherwise the parts are filled later, and may contain themselves
        )
        content = super().construct_document(node)
        if _size(node, {}) > MOST_PARTS:
            raise yaml.constructor.ConstructorError(
                None, None, f"its aliases stand for more than {MOST_PARTS} entries", node.start_mark
            )
        return content

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is not a name", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)
