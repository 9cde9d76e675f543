"""Find the methods in ``baselines/<name>/``, load them, and explain why one cannot run.

A folder with ``card.yaml`` and ``adapter.py`` is a method; nothing else has to be edited to add one.
Folders whose names start with ``_`` hold shared helpers or the template. Further folders of methods
are named in the environment variable ``DCREG_BASELINES_PATH``. Installed packages add methods by the
entry points of the group ``dcreg.baselines`` (`dcreg.plugins`).
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from pydantic import ValidationError

from baselines.contract import Baseline, Card
from baselines.dependencies import files_behind
from baselines.options import check_option
from dcreg._version import __version__ as repository_version
from dcreg.plugins import Plugin, PluginError, files_under, import_file, plugins
from dcreg.problem.problem import suggestion

ROOT = Path(__file__).resolve().parent
VERSIONS = "versions.json"
GROUP = "dcreg.baselines"  # of entry points
SEARCH_PATH = "DCREG_BASELINES_PATH"
NAME = re.compile(r"[a-z][a-z0-9_]*")
NOT_YAML = (yaml.YAMLError, ValueError, AttributeError, RecursionError)  # what PyYAML raises

# Facts of a card that are not part of the hash of a method's code. All but `version` are only shown.
PRESENTATION = {
    "display_name", "summary", "input", "provenance", "language", "how_to_get", "citation", "licence",
    "url", "color", "marker", "ranges", "solves_assignments", "version",
}  # fmt: skip


class BaselineError(ValueError):
    """A method's name, option or folder is wrong; the message names place, value and remedy."""


def roots() -> list[Path]:
    """Return the folders searched for methods.

    Raises
    ------
    BaselineError
        An entry of the environment variable is not a folder.
    """
    entries = filter(None, os.environ.get(SEARCH_PATH, "").split(os.pathsep))
    extra = [Path(entry).expanduser().resolve() for entry in entries]
    for folder in extra:
        if not folder.is_dir():
            raise BaselineError(f"{SEARCH_PATH}: {folder} is not a folder; correct it")
    return list(dict.fromkeys([ROOT, *extra]))


def names(root: Path | None = None) -> list[str]:
    """Return the names of all methods, or of those under `root`, sorted."""
    folders = {
        folder.name
        for place in ([root] if root else roots())
        for folder in place.iterdir()
        if _is_method(folder)
    }
    return sorted(folders if root else folders | {plugin.name for plugin in plugins(GROUP)})


def _is_method(folder: Path) -> bool:
    parts = (folder / part for part in ("card.yaml", "adapter.py"))
    return not folder.name.startswith(("_", ".")) and any(part.is_file() for part in parts)


def root_of(name: str) -> Path:
    """Return the folder that contains the folder of the method `name`."""
    return folder_of(name).parent


def folder_of(name: str, root: Path | None = None) -> Path:
    """Return the folder of a method, in `root` if given.

    Raises
    ------
    BaselineError
        The method is unknown, it is defined twice, or its package has no such folder.
    """
    folders = [place / name for place in ([root] if root else roots())]
    places = [folder for folder in folders if folder.name == name and _is_method(folder)]
    added = [] if root else _plugins_named(name)
    if len(places) + len(added) > 1:
        parties = [*map(shown, places), *(plugin.origin for plugin in added)]
        raise BaselineError(
            f"method {name!r} is defined twice: by {' and by '.join(parties)}; rename one of them"
        )
    if places:
        return places[0]
    if not added:
        raise BaselineError(f"unknown method {name!r}{suggestion(name, names(root))}")
    if not NAME.fullmatch(name):
        raise BaselineError(f"{added[0].origin}: {bad_name(name)}")
    try:
        return added[0].files
    except PluginError as error:
        raise BaselineError(str(error)) from error


def origin_of(name: str) -> str:
    """Return where a method comes from: its folder, or the package that adds it."""
    added = _plugins_named(name)
    return added[0].origin if added else shown(folder_of(name))


def _plugins_named(name: str) -> list[Plugin]:
    return [plugin for plugin in plugins(GROUP) if plugin.name == name]


def bad_name(name: str) -> str:
    """Return why `name` is not a valid name of a method."""
    return f"{name!r} cannot name a method: use a lower-case letter, then letters, digits or _"


def load(name: str, *, root: Path | None = None, **options: Any) -> Baseline:
    """Return the method `name`, configured with `options` over the defaults of its card.

    Raises
    ------
    BaselineError
        For an unknown method or option, a value of the wrong type or out of its range, or a broken
        folder.
    """
    card = read_card(name, root)
    for option, value in options.items():
        if problem := check_option(card, option, value):
            raise BaselineError(f"{name}: {problem}")
    path = folder_of(name, root) / "adapter.py"
    added = [] if root else _plugins_named(name)
    module = _import_adapter(path, added[0].module if added else "")
    adapter = getattr(module, "Adapter", None)
    if not (isinstance(adapter, type) and issubclass(adapter, Baseline)):
        raise BaselineError(
            f"{shown(path)}: no class Adapter(Baseline); "
            "define one, see baselines/_template/adapter.py"
        )
    try:
        return adapter(card, **options)
    except ValueError as error:
        raise BaselineError(f"{name}: {error}") from error


def read_card(name: str, root: Path | None = None) -> Card:
    """Return the validated ``card.yaml`` of method `name`."""
    path = folder_of(name, root) / "card.yaml"
    try:
        content = _parsed(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise BaselineError(
            f"{shown(path)}: missing; copy it from baselines/_template/card.yaml"
        ) from error
    except NOT_YAML as error:
        raise BaselineError(f"{shown(path)}: not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise BaselineError(f"{shown(path)}: must be a mapping of fields, is {content!r}")
    try:
        return Card.model_validate(content)
    except ValidationError as error:
        raise BaselineError(_card_message(path, error)) from error
    except TypeError as error:  # a range of what is not a number
        raise BaselineError(f"{shown(path)}: field ranges: {error}; correct it") from error


@functools.lru_cache(maxsize=256)
def _parsed(card: str) -> Any:
    """Return the content of a card: cards are read many times, and YAML takes long."""
    return yaml.safe_load(card)


def idle_options(name: str, options: dict[str, Any]) -> dict[str, str]:
    """Return the options without effect given `options`; none if the method cannot be loaded."""
    try:
        return load(name, **options).idle_options()
    except (ImportError, BaselineError):
        return {}


def effective_options(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return all options of a run: those given over the defaults of the card."""
    return {**read_card(name).parameters, **options}


def oracle_outliers(name: str, options: dict[str, Any]) -> float | None:
    """Return the share of random pairs that the front end ``oracle`` asks for; None for others."""
    settings = effective_options(name, options)
    return settings["oracle_outliers"] if settings.get("front_end") == "oracle" else None


def availability(root: Path | None = None) -> list[dict[str, Any]]:
    """Return a row per method: what it is, whether it can run here, and if not, why.

    The row of a method that cannot be loaded has the reason only.
    """
    return [facts(name, root) for name in names(root)]


def facts(name: str, root: Path | None = None) -> dict[str, Any]:
    """Return the row of a method."""
    try:
        method = load(name, root=root)
        card, reason = method.card, method.available()
    except (BaselineError, ImportError, SyntaxError, NameError) as error:
        unknown = dict.fromkeys(
            ("models", "version", "provenance", "language", "bounds", "input"), ""
        )
        broken = {"available": False, "reason": f"{type(error).__name__}: {error}"}
        texts = {"licence": "", "citation": "", "parameters": {}, "deterministic": True}
        return {"name": name, "method": name, **unknown, **broken, **texts}
    return {
        "name": name,
        "method": card.display_name,
        "models": ", ".join(card.models),
        "available": reason is None,
        "reason": reason or "",
        "version": version(card, [] if root else _plugins_named(name)),
        "provenance": card.provenance,
        "language": card.language,
        "bounds": card.certifies if card.provides_bounds else "none",
        "input": card.input,
        "deterministic": card.deterministic,
        "parameters": card.parameters,
        "licence": card.licence,
        "citation": card.citation,
    }


def version(card: Card, added_by: Sequence[Plugin] = ()) -> str:
    """Return the version of the required distribution, else of what adds the method."""
    if not card.requires:
        return metadata.version(added_by[0].distribution) if added_by else repository_version
    module = card.requires.partition(".")[0]
    candidates = [module, *_distributions().get(module, [])]
    return _installed_version(candidates) or "not installed"


def fingerprint(
    name: str, root: Path | None = None, options: Mapping[str, Any] | None = None
) -> str:
    """Return what identifies the results of method `name` with the given options.

    This is its declared version, if its code is known to give the results of that version
    (`known_codes`), otherwise the hash of its code. The version of the package that it requires is part
    of both. If the options select the search of this library, so is the fingerprint of `dcreg`.
    """
    card, code = read_card(name, root), code_hash(name, root)
    package = f" {card.requires} {version(card)}" if card.requires else ""
    chosen = card.parameters | dict(options or {})
    if card.library_search and card.library_search.items() <= chosen.items():
        package += f" + {fingerprint('dcreg')}"
    known = known_codes(root or root_of(name)).get(name, {})
    if known.get("version") == card.version and code in known["codes"]:
        return f"{name} {card.version}{package}"
    return f"{code}{package}"


def known_codes(root: Path | None = None) -> dict[str, Any]:
    """Return, by method, the declared version, the hashes of code with its results, and these results.

    `workflows.versions` writes them.
    """
    path = (root or ROOT) / VERSIONS
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def code_hash(name: str, root: Path | None = None) -> str:
    """Hash all code and defaults that determine the results of method `name`.

    This is its folder, or the whole package that adds it, and all code of this checkout that it imports.
    It depends on files only: no adapter is imported. Facts of the card that are only shown
    (`PRESENTATION`) do not count.
    """
    card = read_card(name, root)
    digest = hashlib.sha256()
    solving = card.model_dump(exclude=PRESENTATION)
    digest.update(json.dumps(solving, sort_keys=True, default=str).encode())
    for path in code_of(name, root):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def code_of(name: str, root: Path | None = None) -> list[Path]:
    """Return the files that determine the results of a method: its folder and its imports.

    All files of the folder except the card count, including child processes and data files. All files
    of a package that adds the method count.
    """
    folder = folder_of(name, root)
    if root is None and (added := _plugins_named(name)):
        folder = added[0].package
    own = [path for path in files_under(folder) if path.name != "card.yaml"]
    behind = files_behind([*own, ROOT / "contract.py"], ROOT.parent)
    return sorted(behind, key=shown)


def _import_adapter(path: Path, package: str) -> ModuleType:
    """Import a file ``adapter.py``: of a package that adds a method, of this folder, or of any other."""
    if not path.is_file():
        raise BaselineError(f"{shown(path)}: missing; copy it from baselines/_template/adapter.py")
    if path.parents[1] == ROOT:
        return importlib.import_module(f"baselines.{path.parent.name}.adapter")
    try:
        if package:
            return importlib.import_module(f"{package}.adapter")
        return import_file(path)
    except ImportError:
        raise
    except Exception as error:  # what the code of others raises
        raise BaselineError(
            f"{shown(path)}: cannot be loaded: {type(error).__name__}: {error}"
        ) from error


def _card_message(path: Path, error: ValidationError) -> str:
    problem = error.errors()[0]
    field = ".".join(str(part) for part in problem["loc"])
    message = f"{shown(path)}: field {field}: {problem['msg']}"
    if problem["type"] == "extra_forbidden":
        return f"{message}{suggestion(field, Card.model_fields)}"
    if problem["type"] == "missing":
        return f"{message}; add it, see baselines/_template/card.yaml"
    return f"{message}, is {problem['input']!r}; see baselines/contract.py"


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Return the distributions of each importable package; slow, hence cached."""
    return metadata.packages_distributions()


def _installed_version(distributions: Iterable[str]) -> str | None:
    for distribution in distributions:
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
    return None


def shown(path: Path) -> str:
    """Return a path relative to the checkout if it lies there."""
    return str(path.relative_to(ROOT.parent) if path.is_relative_to(ROOT.parent) else path)
