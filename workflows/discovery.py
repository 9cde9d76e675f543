"""Finds the modules of a package, so that a new metric or figure is one file and no list is edited."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from importlib import import_module
from types import ModuleType
from typing import Any

from dcreg.plugins import Plugin


def modules(package: ModuleType) -> list[ModuleType]:
    """Import the public modules directly below a package, sorted by name."""
    names = sorted(found.name for found in pkgutil.iter_modules(package.__path__))
    return [import_module(f"{package.__name__}.{name}") for name in names if name[0] != "_"]


def added_modules(found: Iterable[Plugin], register: dict[str, Any]) -> dict[str, str]:
    """Import the modules of entry points, which fill a register; return the reason of each failure.

    Entries that a module made before it failed are removed.
    """
    broken = {}
    for plugin in found:
        before = dict(register)
        try:
            import_module(plugin.module)
        except Exception as error:  # what the code of others raises
            register.clear()
            register.update(before)
            broken[plugin.origin] = f"{type(error).__name__}: {error}"
    return broken
