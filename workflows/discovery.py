"""Finds the modules of a package, so that a new metric or figure is one file and no list is edited."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from types import ModuleType


def modules(package: ModuleType) -> list[ModuleType]:
    """Import the public modules directly below a package, sorted by name."""
    names = sorted(found.name for found in pkgutil.iter_modules(package.__path__))
    return [import_module(f"{package.__name__}.{name}") for name in names if name[0] != "_"]
