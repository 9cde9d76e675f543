"""DCP, deep closest point, from the user's checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines._shared.learned import LearnedMethod
from baselines._shared.starts import check_choice
from baselines.contract import Card


class Adapter(LearnedMethod):
    """Clouds are centred and divided by the radius of the source, as in the training."""

    folder = Path(__file__).parent
    expects = ("model.py",)
    least_points = 20  # neighbours in the graph of the network

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        check_choice(self, "pointer", ("transformer", "identity"))
