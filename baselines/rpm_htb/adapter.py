"""RPM-HTB, reconstructed: the library's search with term-wise bounds in place of the DC bound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from baselines._shared.library_search import OwnBound
from baselines.contract import Card, Instance
from baselines.rpm_htb.bounds import TermwiseBound, TermwiseR1, TermwiseR2
from baselines.rpm_htb.lp import TermwiseR3
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import Strongest
from dcreg.problem import suggestion
from dcreg.search import Bound, Box

BOUNDS: dict[str, type[TermwiseBound]] = {
    "termwise-r1": TermwiseR1,
    "termwise-r2": TermwiseR2,
    "termwise-r3": TermwiseR3,
}
ALIASES = {"termwise": "termwise-r1+termwise-r2"}


class Adapter(OwnBound):
    """Search, box, tolerance, assignment and polish of DC-Reg in mode `paper`; only the bound differs."""

    bounds = tuple(BOUNDS)

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self.own_bound = str(self.options["bound"])
        words = self.own_bound.split("+")
        self.parts = "+".join(ALIASES.get(word, word) for word in words).split("+")
        if unknown := [part for part in self.parts if part not in BOUNDS]:
            raise ValueError(
                f"option bound = {unknown[0]!r}{suggestion(unknown[0], [*ALIASES, *BOUNDS])}"
            )

    def supports(self, instance: Instance) -> str | None:
        if instance.dim == 3 and "termwise-r3" in self.parts:
            return f"bound termwise-r3 does not support {instance.model}"
        return super().supports(instance)

    def make_bound(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> Bound:
        made = [BOUNDS[part](space, roots, threads) for part in self.parts]
        return made[0] if len(made) == 1 else Strongest(made)
