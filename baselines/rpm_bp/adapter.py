"""RPM-BP, reconstructed: variable substitution and bilinear envelopes."""

from collections.abc import Sequence
from typing import Any

from baselines._shared.own_search import EitherSearch
from baselines._shared.relaxations import Relaxation
from baselines.rpm_bp.bound import BilinearBound
from dcreg.search import Box


class Adapter(EitherSearch):
    """Branch and bound over theta; a box costs one k-assignment and one convex QP of low dimension."""

    own_bound = "rpm-bp"

    def relaxations(
        self, space: Any, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> list[Relaxation[Any]]:
        return [BilinearBound(space, roots, threads)]
