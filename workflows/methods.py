"""The methods of `baselines`, and those of extra folders named in ``DCREG_BASELINES_PATH``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from baselines import registry
from baselines.contract import Baseline, Card


def roots() -> list[Path]:
    """Folders searched for methods, in order."""
    extra = os.environ.get("DCREG_BASELINES_PATH", "")
    return [registry.ROOT, *(Path(entry).resolve() for entry in extra.split(os.pathsep) if entry)]


def names() -> list[str]:
    return sorted({name for root in roots() for name in registry.names(root)})


def root_of(name: str) -> Path:
    """The folder that holds method `name` (the first of `roots`, where unknown)."""
    return next((root for root in roots() if name in registry.names(root)), registry.ROOT)


def card(name: str) -> Card:
    return registry.read_card(name, root_of(name))


def load(name: str, options: dict[str, Any]) -> Baseline:
    return registry.load(name, root=root_of(name), **options)


def idle_options(name: str, options: dict[str, Any]) -> dict[str, str]:
    """Options that nothing comes of beside these; none where the method cannot be loaded."""
    try:
        return load(name, options).idle_options()
    except (ImportError, registry.BaselineError):
        return {}


def oracle_outliers(name: str, options: dict[str, Any]) -> float | None:
    """Share of random pairs that a method with the front end ``oracle`` asks for; None for others."""
    settings = {**card(name).parameters, **options}
    return settings["oracle_outliers"] if settings.get("front_end") == "oracle" else None


def fingerprint(name: str) -> str:
    """Hash of everything whose text decides the results of this method."""
    return registry.fingerprint(name, root_of(name))
