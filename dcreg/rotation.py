"""Global rotation search: the second stage of the 3D pipeline.

Solved is, for points a_i (translation already applied), y_j and k pairs,

    min over R in SO(3) and one-to-one P of k pairs of  E_P(R) = sum_ij p_ij |R a_i - y_j|^2,

a rotation about the origin, without centring. DC-Reg (arXiv 2603.25442) leaves this stage to any
rotation search; the two bounds here are this project's choice, not the paper's.

Why boxes of quaternions
------------------------
theta is a quaternion (w, x, y, z) of any length. The eight facets of the cube [-1, 1]^4 hold each
quaternion once up to length; q and -q are the same rotation, so the four facets where one
component is +1 hold every rotation, and only those on their rims more often. They are the roots.
A box has zero width along its facet's axis, is never divided there, and needs no chart number.
Both bounds are native to such boxes. The angle-axis cube would waste 48 % of its volume outside
the pi-ball, cover half-turns twice and need an enclosure by such a box for B2.

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
R is linear in q q^T for unit q (`lift_matrix`), and E_P(R) = sum p_ij (|a_i|^2 + |y_j|^2 - 2
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

import time
from dataclasses import dataclass, field

import numpy as np

from dcreg.assignment import pairs_of
from dcreg.box import Box, LongestEdge
from dcreg.kernels import rotation as kernels
from dcreg.models.base import radius, with_prices
from dcreg.result import Status
from dcreg.search import Evaluation, Limits, branch_and_bound
from dcreg.trace import Event, Listener

# The first incumbent: the best rotations of this regular grid, by nearest neighbours, each refined.
_START_CELLS_PER_AXIS = 4
_START_DESCENTS = 8
_ROUND_PAIRS = 4_000_000  # pairs looked at between two readings of the clock


@dataclass(frozen=True)
class RotationResult:
    """The best rotation about the origin, with bounds on the optimum of its own objective.

    Attributes
    ----------
    rotation : (3, 3) array
        Proper (determinant +1); maps the shifted source onto the target.
    assignment : (n_inliers, 2) int array
        Matched pairs (source row, target row) at `rotation`.
    lower_bound, upper_bound : float
        `upper_bound` is the objective at `rotation`.
    n_nodes, n_assignments : int
    status : Status
    time_s : float
    events : list of Event
        Bound history, stage ``rotation``.
    """

    rotation: np.ndarray
    assignment: np.ndarray
    lower_bound: float
    upper_bound: float
    n_nodes: int
    n_assignments: int
    status: Status
    time_s: float
    events: list[Event] = field(default_factory=list)


class RotationModel:
    """Rotations about the origin; theta is a quaternion (w, x, y, z) of any length but zero.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    n_inliers : int
    candidates : (n, m) bool array, optional
        The feasible pairs.
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        candidates: np.ndarray | None = None,
    ) -> None:
        self.source = np.ascontiguousarray(np.asarray(source, dtype=np.float64).T)
        target = np.asarray(target, dtype=np.float64)
        reach = radius(source) + radius(target)
        self.target = with_prices(target.T, candidates, n_inliers, reach)
        self.n_inliers = n_inliers

    @staticmethod
    def roots() -> list[Box]:
        """The four facets w, x, y, z = 1 of the cube [-1, 1]^4: together every rotation."""
        boxes = []
        for axis in range(4):
            lower = -np.ones(4)
            lower[axis] = 1.0
            boxes.append(Box(lower, np.ones(4)))
        return boxes

    @staticmethod
    def grid(cells: int) -> np.ndarray:
        """(4 cells^3, 4) quaternions: the centres of a regular division of the four facets."""
        steps = (2.0 * np.arange(cells) + 1.0) / cells - 1.0
        facet = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.concatenate([np.insert(facet, axis, 1.0, axis=1) for axis in range(4)])

    @staticmethod
    def matrix(theta: np.ndarray) -> np.ndarray:
        """The rotation of a quaternion: proper, and the same for theta, -theta and 2 theta."""
        return kernels.rotation_matrix(np.asarray(theta, dtype=np.float64))

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """E at a rotation and the column matched to every source row (-1: none)."""
        return kernels.objective(theta, self.source, self.target, self.n_inliers)

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and best rotation from `theta`: theta, objective, assignments."""
        theta, value, spent = kernels.refine(theta, self.source, self.target, self.n_inliers)
        return theta / theta[np.argmax(np.abs(theta))], value, spent

    def start(self, time_limit: float | None = None) -> tuple[np.ndarray, float, int]:
        """Best of a few descents from a regular grid: theta, objective, assignments.

        At least one descent is made, however short the time.
        """
        began = time.perf_counter()
        grid = self.grid(_START_CELLS_PER_AXIS)
        scores = kernels.nearest_scores(grid, self.source, self.target, self.n_inliers)
        theta, value, spent = self.refine(grid[np.argmin(scores)])
        for at in np.argsort(scores, kind="stable")[1:_START_DESCENTS]:
            if time_limit is not None and time.perf_counter() - began > time_limit:
                break
            other, other_value, assignments = self.refine(grid[at])
            spent += assignments
            if other_value < value:
                theta, value = other, other_value
        return theta, value, spent


class RotationBound:
    """max(B1, B2) over boxes of quaternions; proofs in the module's docstring.

    Attributes
    ----------
    n_assignments : int
        Exact k-assignments solved so far.
    """

    def __init__(self, model: RotationModel) -> None:
        self.model = model
        self.n_assignments = 0

    def evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        """Bound B boxes; candidates are their centres. Above `cutoff` precision is of no use."""
        bounds, values = np.empty(len(lower)), np.empty(len(lower))
        model = self.model
        self.n_assignments += kernels.bound_boxes(
            lower, upper, cutoff, model.source, model.target, model.n_inliers, bounds, values
        )
        return Evaluation(bounds, 0.5 * (lower + upper), values)


def search_rotation(
    source_shifted: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    *,
    gap_tol: float,
    time_limit: float | None = None,
    node_limit: int | None = None,
    candidates: np.ndarray | None = None,
    listener: Listener | None = None,
) -> RotationResult:
    """Rotation about the origin that brings `n_inliers` pairs closest, globally to `gap_tol`.

    Minimises ``sum p_ij |R a_i - y_j|^2`` over proper rotations R and one-to-one matchings P of
    exactly `n_inliers` pairs, by best-first branch and bound over quaternions.

    Parameters
    ----------
    source_shifted, target : (n, 3), (m, 3) arrays
        The translation is already applied to the source; nothing is centred.
    n_inliers : int
    gap_tol : float
        Absolute tolerance on ``upper_bound - lower_bound``, in squared units of the points.
    time_limit : float, optional
        Seconds, checked after each round of boxes.
    node_limit : int, optional
        Boxes bounded.
    candidates : (n, m) bool array, optional
        The feasible pairs.
    listener : callable, optional
        Receives every `dcreg.trace.Event` (stage ``rotation``); returning True stops the search.

    Returns
    -------
    RotationResult
        Its bounds hold whatever the status.
    """
    began = time.perf_counter()
    model = RotationModel(source_shifted, target, n_inliers, candidates)
    bound = RotationBound(model)
    theta, value, bound.n_assignments = model.start(time_limit)
    spent = time.perf_counter() - began
    left = None if time_limit is None else max(0.0, time_limit - spent)
    found = branch_and_bound(
        bound,
        model.roots(),
        branching=LongestEdge(np.ones(4)),
        gap_tol=gap_tol,
        refine=model.refine,
        start=(theta, value),
        limits=Limits(left, node_limit),
        round_size=int(np.clip(_ROUND_PAIRS // (len(source_shifted) * len(target)), 1, 32)),
        listener=listener,
        stage="rotation",
    )
    _, col_of = model.objective(found.theta)
    return RotationResult(
        model.matrix(found.theta),
        pairs_of(col_of),
        found.lower_bound,
        found.upper_bound,
        found.n_nodes,
        found.n_assignments,
        found.status,
        time.perf_counter() - began,
        found.events,
    )
