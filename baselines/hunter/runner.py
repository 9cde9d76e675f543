"""Runs in the child process: a function ``module:name`` of the checkout, named by option ``entry``."""

import importlib


def load(checkout, weights, settings):
    """The entry, called as ``entry(source, target, weights, device)``."""
    module, _, name = settings["entry"].partition(":")
    entry = getattr(importlib.import_module(module), name)
    return lambda problem: entry(problem["source"], problem["target"], weights, settings["device"])
