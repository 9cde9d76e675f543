"""The benchmark: plan, fetch, generate, solve, evaluate, aggregate, report, compare."""

from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]


class UserError(ValueError):
    """Something a user can mend; the message names place, value and remedy."""
