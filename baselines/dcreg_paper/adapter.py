"""DC-Reg as its paper writes it: Algorithm 1 with the published bound, then a rotation search in 3D."""

from __future__ import annotations

from typing import Any

from baselines._shared.own_search import check_options, search_alone, too_large
from baselines._shared.published import published_bound
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from baselines.hbsp.rotation import rotation_alone


class Adapter(Baseline):
    """2D: the similarity. 3D: the translation in norm space, then the rotation for it."""

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        check_options(self)

    def supports(self, instance: Instance) -> str | None:
        return super().supports(instance) or too_large(instance)

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        found = search_alone(instance, limits, self.options, published_bound, rotation_alone)
        return found.solution()
