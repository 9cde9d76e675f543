"""Whether a method can run on this machine."""

from __future__ import annotations

from baselines import registry
from workflows.config import MethodSettings


def runs_here(method: MethodSettings) -> bool:
    """Tell whether a method is installed, and can run on this machine."""
    return not why_not_here(method)


def why_not_here(method: MethodSettings) -> str:
    """Return why a method cannot run on this machine; empty if it can."""
    try:
        return registry.load(method.baseline, **method.options).available() or ""
    except ImportError as error:
        return str(error)
