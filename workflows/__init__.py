"""The benchmark: plan, fetch, generate, solve, evaluate, aggregate, report, compare."""

from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]


class UserError(ValueError):
    """Something a user can mend; the message names place, value and remedy."""


def shown(path: Path) -> str:
    """A path as messages show it: from the checkout, where it lies in it."""
    path = path.resolve()
    return str(path.relative_to(CHECKOUT) if path.is_relative_to(CHECKOUT) else path)
