"""The files of an archive that repeat its experiments: configs, and the code of your own methods."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from baselines import registry as methods
from baselines.registry import BaselineError
from data import registry as datasets
from data.contract import DataError
from reports.tables import Tables
from workflows import CHECKOUT
from workflows.blocks import NEEDS
from workflows.config import search_next_to

AGAIN = "-again"  # ends the name of a repeated experiment: results are stored by name
CITATION = "CITATION.cff"
README = "REPEAT.md"
CODE = (".py", ".yaml", ".yml", ".toml", ".md")  # what is copied of a dataset: no clouds
NOT_INCLUDED = "its code is not included"
_REMEDY = {
    "baselines": f"Set {methods.SEARCH_PATH} to the folder that holds it",
    "data": f"Set {datasets.SEARCH_PATH} to the folder that holds it",
}


def write_sources(tables: Tables, out: Path) -> list[str]:
    """Write the config of an experiment to `out`, and all code that this checkout does not have.

    Methods and datasets are next to the config, where `workflows.config.search_next_to` finds them.

    Returns
    -------
    list of str
        The methods, datasets and packages whose code was written, or why it could not be.
    """
    provenance = tables.provenance
    if config_file := provenance.get("config_file"):
        search_next_to(CHECKOUT / config_file)
    config = {**provenance.get("config", {}), "name": f"{tables.experiment}{AGAIN}"}
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
    (out / "config.yaml").write_text(text, encoding="utf-8")
    used = dict.fromkeys(
        card.get("baseline", name) for name, card in provenance.get("methods", {}).items()
    )
    return [
        *_copies(used, methods, "baselines", out),
        *_copies(dict.fromkeys(tables.runs["dataset"]), datasets, "data", out),
    ]


def public(provenance: dict[str, Any]) -> dict[str, Any]:
    """Return the provenance of an experiment without places outside of the checkout.

    Paths of one's own contain names of users and projects. Those of files in the archive are replaced by
    their places there.
    """
    known = dict(provenance)
    if "RESULTS=" in known.get("replay", ""):
        del known["replay"]
    if "git" in known:
        known["git"] = {key: value for key, value in known["git"].items() if key != "untracked"}
    if _is_elsewhere(known.get("config_file", "")):
        known["config_file"] = ""
    if "commands" in known:
        known["commands"] = [_public_command(each) for each in known["commands"]]
    known["methods"] = {
        name: {**card, "origin": f"baselines/{card.get('baseline', name)}"}
        if _is_elsewhere(card.get("origin", ""))
        else card
        for name, card in provenance.get("methods", {}).items()
    }
    return known


def _is_elsewhere(path: str) -> bool:
    return Path(path).is_absolute() or Path(path).parts[:1] == ("..",)


def _public_command(command: str) -> str:
    words = ("config.yaml" if _is_elsewhere(word) else word for word in shlex.split(command))
    return shlex.join(words)


def write_readme(
    experiments: dict[str, list[str]],
    provenances: dict[str, dict[str, Any]],
    version: str,
    out: Path,
) -> None:
    """Say where the experiments of an archive are from, how to repeat them, and how to cite it."""
    lines = [
        f"# Results, version {version}",
        "",
        f"Experiments of the DC-Reg benchmark; `{CITATION}` says how to cite it. "
        "`checksums.sha256` verifies all files.",
        "",
    ]
    for name, added in experiments.items():
        lines += [
            f"- `{name}`, {_origin(provenances[name])}: "
            f"`make run CONFIG=<this folder>/experiments/{name}/config.yaml`"
        ]
        if (out / "experiments" / name / NEEDS).is_file():
            lines += [
                f"  - Only the trials in `{NEEDS}` were run; the command above runs all. "
                f"`make evidence EXPERIMENTS={name}` adds more."
            ]
        lines += [f"  - {each}" for each in added]
    (out / README).write_text("\n".join(lines) + "\n", encoding="utf-8")
    shutil.copyfile(CHECKOUT / CITATION, out / CITATION)


def _origin(provenance: dict[str, Any]) -> str:
    """Return when and with which commit the tables of an experiment were made."""
    git = provenance.get("git", {})
    origin = f"tables made {provenance.get('created', 'at an unknown time')[:10]}"
    origin += f" with commit {str(git.get('commit') or 'unknown')[:8]}"
    return origin + " and uncommitted changes" * bool(git.get("dirty"))


def _copies(names: Iterable[str], registry: Any, kind: str, out: Path) -> Iterable[str]:
    """Copy the code that is outside the checkout or has the provenance own; yield a line for each."""
    added = {plugin.name: plugin for plugin in registry.plugins(registry.GROUP)}
    for name in names:
        try:
            if name in added:
                package = added[name].package
                _copy(package, out / "packages" / package.name)
                yield f"{name}: {added[name].origin}, whose code is in `packages/{package.name}`"
                continue
            folder = (
                methods.folder_of(name)
                if registry is methods
                else registry.dataset(name).card.folder
            )
        except (BaselineError, DataError) as error:
            yield f"{name}: {NOT_INCLUDED}: {_first_clause(error)}. {_REMEDY[kind]}, and publish again"
            continue
        is_own = registry is methods and methods.read_card(name).provenance == "own"
        if folder.parent != CHECKOUT / kind or is_own:
            copy = _copy if registry is methods else _copy_code
            copy(folder, out / kind / name)
            yield f"{name}: in `{kind}/{name}`" + (
                "" if registry is methods else " without its clouds"
            )


def _first_clause(error: Exception) -> str:
    """Return a message without the names that are known, of which there are many."""
    return str(error).partition(";")[0]


def missing_code(archive: Path) -> list[str]:
    """Return the lines of the readme about code that an archive does not have."""
    lines = (archive / README).read_text(encoding="utf-8").splitlines()
    return [line.strip(" -") for line in lines if NOT_INCLUDED in line]


def _copy(place: Path, to: Path) -> None:
    if place.is_dir():
        shutil.copytree(place, to, ignore=_left_out, dirs_exist_ok=True)
    else:
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(place, to)


def _left_out(folder: str, names: list[str]) -> list[str]:
    """Return the names that are not copied: links, hidden and compiled files."""
    return [
        name
        for name in names
        if name.startswith(".")
        or name == "__pycache__"
        or name.endswith(".so")
        or Path(folder, name).is_symlink()
    ]


def _copy_code(place: Path, to: Path) -> None:
    """Copy the code and the cards of a dataset, not the clouds that may lie next to them."""
    for path in sorted(place.rglob("*")):
        name = path.relative_to(place)
        if path.suffix in CODE and not _left_out(str(path.parent), [path.name]):
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, to / name)
