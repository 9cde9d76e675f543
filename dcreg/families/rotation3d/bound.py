"""Bounds over boxes of quaternions.

DC-Reg (arXiv 2603.25442) leaves the rotation to any search; the two bounds here are this project's,
not the paper's. The objective and the boxes are those of `dcreg.families.rotation3d.space`.

B1, the angular bound (`cap_costs`)
-----------------------------------
Let delta be the largest rotation angle between the centre R_c and the rotations of the box. The
direction of R a differs from that of R_c a by at most delta, so by the triangle inequality on the
sphere angle(R a, y) >= max(0, angle(R_c a, y) - delta) =: phi, and |R a - y|^2 >= |a|^2 + |y|^2 -
2|a||y| cos phi for every R of the box. One k-assignment of these costs bounds E. All are >= 0.

delta is attained at a corner (`box_angle`): the quaternions within an angle of at most 90 degrees
of q_c form the convex cone {q : q.q_c >= cos(alpha) |q||q_c|}; when it holds the corners it holds
the box, their convex hull. Corners farther than 90 degrees away mean delta = pi, all rotations,
which holds too. The rotation angle is twice the angle between quaternions (taken with the sign of
q_c.q >= 0, as above).

B2, the lifted vertex bound (`vertex_bound`)
--------------------------------------------
R is linear in q q^T for unit q (`chord_matrix`), and E_P(R) = sum p_ij (|a_i|^2 + |y_j|^2 - 2
y_j.R a_i) is affine in R; call z(M) = min_P of that affine form at any 3x3 matrix M. It is
concave, as a minimum of affine functions. Let v_a be the corners of the box, with v_a.v_b > 0 for
all a, b, and B_ab = (v_a v_b^T + v_b v_a^T) / (2 v_a.v_b). A quaternion of the box is q = sum_a
c_a v_a, c in the simplex, hence q q^T = sum_ab c_a c_b (v_a.v_b) B_ab and |q|^2 = sum_ab c_a c_b
(v_a.v_b): q q^T / |q|^2 is a convex combination of the B_ab. The concave z is then at least
min_ab z(image of B_ab) at every rotation of the box: 36 vertices for 8 corners. B_ab leaves the
rotations by O(size^2), so B2 is second order.

Few of the 36 assignments are solved. For any b >= 0 the dual bound, the sum of the k smallest
min_j (c_ij + b_j) minus sum_j b_j, is no more than the k-assignment, and with the duals b of B1's
assignment it is close: one pass over the pairs per vertex. Then only the binding vertex is
solved, and its duals serve the others. (Duals alone would lose the second order where the
matching changes in the box.)

The bound of a box is max(B1, B2), evaluated from the cheapest test to the dearest and only as far
as it decides about the cutoff. At a box of one rotation B1 equals E.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.protocol import SpaceBound
from dcreg.families.rotation3d.kernels.rotation import bound_boxes
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Evaluation


class RotationBound(SpaceBound[Rotation3D]):
    """max(B1, B2) over boxes of quaternions; proofs in the module's docstring."""

    name = "rotation"
    space_type = Rotation3D
    round_pairs, max_round = 4_000_000, 32

    def _evaluate(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        cutoff: float | None,
        warm_start: np.ndarray | None,
    ) -> Evaluation:
        bounds, values = np.empty(len(lower)), np.empty(len(lower))
        enough = np.inf if cutoff is None else cutoff
        self.map_slices(
            len(lower),
            lambda part: bound_boxes(
                lower[part], upper[part], enough, self.space.clouds, bounds[part], values[part]
            ),
        )
        return Evaluation(bounds, 0.5 * (lower + upper), values)
