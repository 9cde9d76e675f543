"""The function ``module:name`` of the checkout (option ``entry``), run in the child process."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def load(checkout: str, weights: str, settings: dict[str, Any]) -> Callable[[dict[str, Any]], Any]:
    """Return the entry, called as ``entry(source, target, weights, device)``."""
    module, _, name = settings["entry"].partition(":")
    entry = getattr(importlib.import_module(module), name)
    return lambda problem: entry(problem["source"], problem["target"], weights, settings["device"])
