"""Bounds over boxes of quaternions.

DC-Reg (arXiv 2603.25442) leaves the rotation search open. The two bounds here were derived in this
project and are not in the paper. The objective and the boxes are those of
`dcreg.families.rotation3d.space`.

B1, the angular bound (`cap_costs`)
-----------------------------------
Let delta be the maximum rotation angle between the centre R_c and the rotations of the box. The
directions of R a and R_c a differ by at most delta, so the triangle inequality on the sphere gives
angle(R a, y) >= max(0, angle(R_c a, y) - delta) =: phi, and |R a - y|^2 >= |a|^2 + |y|^2 - 2 |a||y| cos
phi for every R of the box. One k-assignment of these costs bounds E. All costs are >= 0.

delta is attained at a vertex (`box_angle`). The quaternions within an angle of at most 90 degrees of
q_c form the convex cone {q : q.q_c >= cos(alpha) |q||q_c|}. If the cone contains the vertices, it
contains the box, their convex hull. If a vertex is farther than 90 degrees away, delta is set to pi,
which covers all rotations. The rotation angle is twice the angle between the quaternions, taken with
the sign of q_c.q >= 0.

B2, the lifted vertex bound (`vertex_bound`)
--------------------------------------------
R is linear in q q^T for unit q (`chord_matrix`), and E_P(R) = sum p_ij (|a_i|^2 + |y_j|^2 - 2 y_j.R
a_i) is affine in R. Let z(M) = min_P of that affine form at any 3x3 matrix M. It is concave, because it
is a minimum of affine functions. Let v_a be the vertices of the box, with v_a.v_b > 0 for all a, b, and
B_ab = (v_a v_b^T + v_b v_a^T) / (2 v_a.v_b). A quaternion of the box is q = sum_a c_a v_a with c in the
simplex. Hence q q^T = sum_ab c_a c_b (v_a.v_b) B_ab and |q|^2 = sum_ab c_a c_b (v_a.v_b), so q q^T /
|q|^2 is a convex combination of the B_ab. The concave z is then at least min_ab z(image of B_ab) at
every rotation of the box: 36 points for 8 vertices. B_ab differs from a rotation by O(size^2), so B2 is
of second order.

Few of the 36 assignments are solved. For any b >= 0 the dual bound, the sum of the k smallest min_j
(c_ij + b_j) minus sum_j b_j, is no more than the k-assignment. With the dual variables b of B1's
assignment it is close, and it takes one pass over the pairs per point. Only the binding point is then
solved, and its dual variables serve the others. Dual variables alone would lose the second order if the
matching changes within the box.

The bound of a box is max(B1, B2). Cheaper bounds come first. None is evaluated after
one that reaches the cutoff. For a box of one rotation B1 equals E.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.protocol import SpaceBound
from dcreg.families.rotation3d.kernels.rotation import bound_boxes
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Boxes, Evaluation


class RotationBound(SpaceBound[Rotation3D]):
    """max(B1, B2) over boxes of quaternions; proofs in the module's docstring."""

    name = "rotation"
    space_type = Rotation3D
    # a box has up to 36 points with assignments, so threads share few boxes as well
    round_pairs, max_round, slice_pairs = 4_000_000, 32, 1

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        found, clouds = Evaluation.empty(boxes), self.space.clouds
        enough = np.inf if cutoff is None else cutoff
        self.map_slices(
            len(boxes),
            lambda part: bound_boxes(
                boxes.lower[part], boxes.upper[part], enough, clouds, found.lower_bounds[part],
                found.values[part],
            ),
        )  # fmt: skip
        return found
