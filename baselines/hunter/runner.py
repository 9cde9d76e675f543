"""Runs in the child process: a function ``module:name`` of the checkout, named by option ``entry``."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def load(checkout: str, weights: str, settings: dict[str, Any]) -> Callable[[dict[str, Any]], Any]:
    """The entry, called as ``entry(source, target, weights, device)``."""
    module, _, name = settings["entry"].partition(":")
    entry = getattr(importlib.import_module(module), name)
    return lambda problem: entry(problem["source"], problem["target"], weights, settings["device"])
