"""RPM-BP, reconstructed: variable substitution and bilinear envelopes."""

from baselines._shared.relaxations import SimilaritySearch
from baselines.rpm_bp.bound import BilinearBound


class Adapter(SimilaritySearch):
    """Branch and bound over theta; a k-assignment and a convex QP of low dimension for every box."""

    own_bound = "rpm-bp"
    bound = BilinearBound
