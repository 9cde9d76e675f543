"""Find the methods in ``baselines/<name>/``, load them, and explain why one cannot run.

A folder with ``card.yaml`` and ``adapter.py`` is a method; nothing else has to be edited to add one.
Folders whose names start with ``_`` hold shared helpers or the template. Further folders of methods
are named in the environment variable ``DCREG_BASELINES_PATH``.
"""

from __future__ import annotations

import colorsys
import functools
import hashlib
import importlib.util
import json
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from pydantic import ValidationError

from baselines.contract import Baseline, Card
from baselines.dependencies import files_behind
from dcreg._version import __version__ as repository_version
from dcreg.problem.problem import suggestion

ROOT = Path(__file__).resolve().parent
TEMPLATE = ROOT / "_template"
VERSIONS = "versions.json"
NOT_YAML = (yaml.YAMLError, ValueError, AttributeError, RecursionError)  # what PyYAML raises

# Facts of a card that are not part of the hash of a method's code. All but `version` are only shown.
PRESENTATION = {
    "display_name", "summary", "input", "provenance", "language", "how_to_get", "citation", "licence",
    "url", "color", "marker", "ranges", "solves_assignments", "version",
}  # fmt: skip


class BaselineError(ValueError):
    """A method's name, option or folder is wrong; the message names place, value and remedy."""


def roots() -> list[Path]:
    """Return the folders searched for methods, in order."""
    extra = os.environ.get("DCREG_BASELINES_PATH", "")
    return [ROOT, *(Path(entry).resolve() for entry in extra.split(os.pathsep) if entry)]


def names(root: Path | None = None) -> list[str]:
    """Return the names of all methods, or of those under `root`, sorted."""
    return sorted(
        {
            folder.name
            for place in ([root] if root else roots())
            for folder in place.iterdir()
            if folder.is_dir()
            and not folder.name.startswith(("_", "."))
            and any((folder / part).is_file() for part in ("card.yaml", "adapter.py"))
        }
    )


def root_of(name: str) -> Path:
    """Return the first of `roots` that has the method `name`."""
    root = next((root for root in roots() if name in names(root)), None)
    if root is None:
        raise BaselineError(f"unknown method {name!r}{suggestion(name, names())}")
    return root


def load(name: str, *, root: Path | None = None, **options: Any) -> Baseline:
    """Return the method `name`, configured with `options` over the defaults of its card.

    Raises
    ------
    BaselineError
        For an unknown method or option, a value of the wrong type or out of its range, or a broken
        folder.
    """
    root = root or root_of(name)
    card = read_card(name, root)
    for option, value in options.items():
        _check_option(name, card, option, value)
    module = _import_adapter(name, root)
    adapter = getattr(module, "Adapter", None)
    if not (isinstance(adapter, type) and issubclass(adapter, Baseline)):
        raise BaselineError(
            f"{_shown(root / name / 'adapter.py')}: no class Adapter(Baseline); "
            "define one, see baselines/_template/adapter.py"
        )
    try:
        return adapter(card, **options)
    except ValueError as error:
        raise BaselineError(f"{name}: {error}") from error


def read_card(name: str, root: Path | None = None) -> Card:
    """Return the validated ``card.yaml`` of method `name`."""
    root = root or root_of(name)
    if name not in (known := names(root)):
        raise BaselineError(f"unknown method {name!r}{suggestion(name, known)}")
    path = root / name / "card.yaml"
    try:
        facts = _parsed(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise BaselineError(
            f"{_shown(path)}: missing; copy it from baselines/_template/card.yaml"
        ) from error
    except NOT_YAML as error:
        raise BaselineError(f"{_shown(path)}: not valid YAML: {error}") from error
    if not isinstance(facts, dict):
        raise BaselineError(f"{_shown(path)}: must be a mapping of fields, is {facts!r}")
    try:
        return Card.model_validate(facts)
    except ValidationError as error:
        raise BaselineError(_card_message(path, error)) from error
    except TypeError as error:  # a range of what is not a number
        raise BaselineError(f"{_shown(path)}: field ranges: {error}; correct it") from error


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
    return [_facts(name, root) for name in names(root)]


def _facts(name: str, root: Path | None) -> dict[str, Any]:
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
        "version": version(card),
        "provenance": card.provenance,
        "language": card.language,
        "bounds": card.certifies if card.provides_bounds else "none",
        "input": card.input,
        "deterministic": card.deterministic,
        "parameters": card.parameters,
        "licence": card.licence,
        "citation": card.citation,
    }


def version(card: Card) -> str:
    """Return the version of the required distribution, or of this repository."""
    if not card.requires:
        return repository_version
    module = card.requires.partition(".")[0]
    candidates = [module, *_distributions().get(module, [])]
    return _installed_version(candidates) or "not installed"


def fingerprint(name: str, root: Path | None = None) -> str:
    """Return what identifies the results of method `name`.

    This is its declared version, if its code is known to give the results of that version
    (`known_codes`), otherwise the hash of its code. The version of the package that it requires is part
    of both.
    """
    root = root or root_of(name)
    card, code = read_card(name, root), code_hash(name, root)
    package = f" {card.requires} {version(card)}" if card.requires else ""
    known = known_codes(root).get(name, {})
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

    This is its folder and all code of this checkout that it imports. It depends on files only: no
    adapter is imported. Facts of the card that are only shown (`PRESENTATION`) do not count.
    """
    root = root or root_of(name)
    card = read_card(name, root)
    digest = hashlib.sha256()
    solving = card.model_dump(exclude=PRESENTATION)
    digest.update(json.dumps(solving, sort_keys=True, default=str).encode())
    for path in code_of(name, root):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def code_of(name: str, root: Path | None = None) -> list[Path]:
    """Return the files that determine the results of a method: its folder and its imports.

    All files of the folder but the card count, including child processes and data files.
    """
    root = root or root_of(name)
    own = [path for path in _files(root / name) if path.name != "card.yaml"]
    behind = files_behind([*own, ROOT / "contract.py"], ROOT.parent)
    return sorted(behind, key=_shown)


def new_baseline(name: str, root: Path = ROOT) -> Path:
    """Copy the template to ``root/name`` with an unused colour; return the folder."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise BaselineError(
            f"{name!r} cannot name a method: use a lower-case letter, then letters, digits or _"
        )
    folder = root / name
    if folder.exists():
        raise BaselineError(f"{_shown(folder)} exists already; choose another name or remove it")
    color = _unused_color(name, root)
    shutil.copytree(TEMPLATE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    for path in _files(folder):
        text = path.read_text(encoding="utf-8")
        text = text.replace("METHOD_NAME", name).replace('"#000000"', f'"{color}"')
        path.write_text(text, encoding="utf-8")
    return folder


def next_steps(name: str) -> str:
    """Return what a user does after `new_baseline`, one step per line."""
    return (
        f"created baselines/{name} from the template; next:\n"
        f"  1. write the method in baselines/{name}/adapter.py (Adapter.solve)\n"
        f"  2. fill in baselines/{name}/card.yaml: name, summary, options and their ranges\n"
        f"  3. test it: .venv/bin/python -m pytest tests/contract/test_baselines.py -k {name}\n"
        f"  4. compare it: add '- {{name: {name}, baseline: {name}}}' to the methods of "
        "an experiment, see docs/benchmark.md"
    )


def _import_adapter(name: str, root: Path) -> ModuleType:
    path = root / name / "adapter.py"
    if not path.is_file():
        raise BaselineError(f"{_shown(path)}: missing; copy it from baselines/_template/adapter.py")
    if root == ROOT:
        return importlib.import_module(f"baselines.{name}.adapter")
    module_name = f"_baselines_elsewhere.{hashlib.sha1(str(path).encode()).hexdigest()}"
    if module_name not in sys.modules:
        spec = importlib.util.spec_from_file_location(module_name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module  # dataclasses look up the module of their class
        spec.loader.exec_module(module)
    return sys.modules[module_name]


def _check_option(name: str, card: Card, option: str, value: Any) -> None:
    if option not in card.parameters:
        raise BaselineError(
            f"{name}: unknown option {option!r}{suggestion(option, card.parameters)}"
        )
    default, admitted = card.parameters[option], card.ranges.get(option)
    if value is None and (default is None or (admitted is not None and admitted.or_null)):
        return
    example = 1.0 if default is None and admitted is not None else default
    if example is None or (value is None and isinstance(example, str)):
        return  # checked by the method
    if not _is_like(value, example):
        raise BaselineError(
            f"{name}: option {option} = {value!r} is a {type(value).__name__}; "
            f"give a {type(example).__name__} such as "
            + (f"{example!r}" if default is None else f"the default {default!r}")
        )
    if admitted is not None and not admitted.admits(value):
        raise BaselineError(f"{name}: option {option} = {value!r}; give {admitted}")


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


def _card_message(path: Path, error: ValidationError) -> str:
    problem = error.errors()[0]
    field = ".".join(str(part) for part in problem["loc"])
    message = f"{_shown(path)}: field {field}: {problem['msg']}"
    if problem["type"] == "extra_forbidden":
        return f"{message}{suggestion(field, Card.model_fields)}"
    if problem["type"] == "missing":
        return f"{message}; add it, see baselines/_template/card.yaml"
    return f"{message}, is {problem['input']!r}; see baselines/contract.py"


def _files(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            yield path


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


def _unused_color(name: str, root: Path) -> str:
    used = {read_card(other, root).color.lower() for other in names(root)}
    hue = int(hashlib.sha1(name.encode()).hexdigest(), 16) % 360
    while True:
        red, green, blue = colorsys.hsv_to_rgb((hue % 360) / 360, 0.65, 0.75)
        color = f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"
        if color not in used:
            return color
        hue += 7


def _shown(path: Path) -> str:
    """Return a path relative to the checkout if it lies there."""
    return str(path.relative_to(ROOT.parent) if path.is_relative_to(ROOT.parent) else path)
