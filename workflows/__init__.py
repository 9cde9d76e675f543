"""The benchmark: plan, fetch, generate, solve, evaluate, aggregate, report, compare."""

from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
HISTORY = CHECKOUT / "reports" / "history"  # of recorded versions


class UserError(ValueError):
    """An error that the user can fix; the message names place, value and remedy."""


def shown(path: Path) -> str:
    """Return a path for messages: relative to the checkout, if it is inside."""
    path = path.resolve()
    return str(path.relative_to(CHECKOUT) if path.is_relative_to(CHECKOUT) else path)
