"""RPM-HTB, reconstructed: branch and bound over the pose with term-wise bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from baselines._shared.algorithm1 import Bounding
from baselines._shared.own_search import EitherSearch
from baselines._shared.relaxations import Relaxation
from baselines.contract import Card, Instance
from baselines.hbsp.rotation import rotation_alone
from baselines.rpm_htb.bounds import TermwiseBound, TermwiseR1, TermwiseR2
from baselines.rpm_htb.lp import TermwiseR3
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.problem import suggestion
from dcreg.search import Box

BOUNDS: dict[str, type[TermwiseBound]] = {
    "termwise-r1": TermwiseR1,
    "termwise-r2": TermwiseR2,
    "termwise-r3": TermwiseR3,
}
ALIASES = {"termwise": "termwise-r1+termwise-r2"}


class Adapter(EitherSearch):
    """The term-wise bounds; in 3D over norm space, then HBSP's rotation search."""

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

    def relaxations(
        self, space: Any, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> list[Relaxation[Any]]:
        return [BOUNDS[part](space, roots, threads) for part in self.parts]

    def make_rotation(self, space: Rotation3D, threads: int) -> Bounding:
        return rotation_alone(space, threads, self.options["incumbents"] == "fit")
