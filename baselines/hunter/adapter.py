"""Hunter from the user's checkout, through a function that the user names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines._shared.learned import LearnedMethod
from baselines.contract import Card


class Adapter(LearnedMethod):
    """We have not seen the authors' code, so nothing is assumed about its functions."""

    folder = Path(__file__).parent

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        module, _, name = self.options["entry"].partition(":")
        if not (module and name.isidentifier()):
            raise ValueError(f"option entry = {self.options['entry']!r}; give module:function")
