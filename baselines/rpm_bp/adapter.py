"""RPM-BP, reconstructed: variable substitution and bilinear envelopes."""

from collections.abc import Sequence

from baselines._shared.library_search import OwnBound
from baselines.rpm_bp.bound import BilinearBound
from dcreg.families.dc.space import FeatureSpace
from dcreg.search import Bound, Box


class Adapter(OwnBound):
    """Branch and bound over theta; a box costs one k-assignment and one convex QP of low dimension."""

    own_bound = "rpm-bp"

    def make_bound(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> Bound:
        return BilinearBound(space, roots, threads)
