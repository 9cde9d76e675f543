"""HBSP's bound for a rotation about the origin: one k-assignment and one SDP per box.

With G = sum p_ij a_i y_j^T the objective is ``sum p_ij (|a_i|^2 + |y_j|^2) - 2 sum_ab G_ab R_ba``. Each
of the nine products is replaced by the mean of its two active McCormick facets, over the range of G_ab
over all matchings and of R_ba over the box. R is linear in Q = q q^T / |q|^2. The relaxation keeps
that Q is positive semidefinite, has trace 1, and satisfies the products of the inequalities of the box
(`LiftedBox`).

Boxes are those of `dcreg.families.rotation3d.space`: quaternions of any length with one component equal
to 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baselines._shared.relaxations import Relaxation, SingleBoxes
from baselines.hbsp.lifted import LiftedBox
from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.rotation3d.kernels.geometry import chord_matrix
from dcreg.families.rotation3d.kernels.rotation import box_corners
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Box, Boxes, Evaluation


class SemidefiniteRotationBound(Relaxation[Rotation3D]):
    """Lower bound of HBSP (reconstructed) over boxes of quaternions; the SDP provides the candidate.

    Every box needs a semidefinite programme. Rounds are small so that the search stays interruptible.
    """

    round_pairs, max_round = 20_000, 4

    def __init__(
        self, space: Rotation3D, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        a, y = space.clouds.source, space.clouds.target
        self.squares = (a**2).sum(axis=0)[:, None] + (y**2).sum(axis=0)
        self.outer = a[:, None, :, None] * y[None, :, None, :]  # (3, 3, n, m)
        self.low = np.array([[self._assign(plane)[0] for plane in row] for row in self.outer])
        self.high = np.array([[-self._assign(-plane)[0] for plane in row] for row in self.outer])
        self.n_assignments += 2 * 9

    def _assign(self, cost: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the minimum of `cost` over all matchings, and the columns of a minimiser."""
        value, col_of, _ = cheapest_pairs(np.ascontiguousarray(cost), self.space.n_inliers)
        return float(value), col_of

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        found, matchings = Evaluation.empty(boxes), self.no_matchings(len(boxes))

        def work(part: slice) -> int:
            lifted = LiftedBox(3)
            rows = range(len(boxes))[part]
            for at in rows:
                box = Box(boxes.lower[at], boxes.upper[at])
                found.lower_bounds[at], found.thetas[at], matchings[at] = self._bound(box, lifted)
                found.values[at] = self.space.objective(found.thetas[at])[0]
            return 2 * len(rows)

        self.map_slices(len(boxes), work)
        return found

    def _bound(self, box: Box, lifted: LiftedBox) -> tuple[float, np.ndarray, np.ndarray]:
        lower, upper = rotation_range(box)
        r_low, r_high = lower.T, upper.T  # [a, b] is the range of R_ba
        r_centre, g_centre = 0.5 * (r_low + r_high), 0.5 * (self.low + self.high)
        constant = (self.low * r_high + self.high * r_low).sum()
        cost = self.squares - 2.0 * np.tensordot(r_centre, self.outer, axes=2)
        value, matching = self._assign(cost)
        # theta = T (1, z) with z in [-1, 1]^3, so that Q = T Y T^T
        fixed = int(np.argmax((box.lower == 1.0) & (box.upper == 1.0)))
        free = np.delete(np.arange(4), fixed)
        T = np.zeros((4, 4))
        T[:, 0] = box.centre
        T[free, [1, 2, 3]] = box.half_widths[free]
        rotating, z = lifted.minimum(T.T @ quaternion_form(-2.0 * g_centre.T) @ T, T.T @ T)
        theta = T @ np.concatenate([[1.0], np.clip(z, -1.0, 1.0)])
        return value + constant + rotating, theta, matching


def rotation_alone(space: Rotation3D, threads: int, fits: bool = True) -> SingleBoxes:
    """Return the bound for a rotation search by itself; `fits` as in `SingleBoxes`."""
    return SingleBoxes([SemidefiniteRotationBound(space, threads=threads)], fits)


def rotation_range(box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of the entries of R over the box: their range over the chords of its vertices."""
    corners = np.empty((16, 4))
    corners = corners[: box_corners(box.lower, box.upper, corners)]
    if (corners @ corners.T <= 0.0).any():  # the box is too wide for the hull of chords
        return np.full((3, 3), -1.0), np.ones((3, 3))
    chords = np.array([chord_matrix(q, r) for q in corners for r in corners])
    return np.maximum(chords.min(axis=0), -1.0), np.minimum(chords.max(axis=0), 1.0)


def quaternion_form(W: np.ndarray) -> np.ndarray:
    """Return symmetric C with ``<C, Q> = sum_ij W_ij R_ij`` for the rotation R of Q = q q^T, |q| = 1."""
    C = np.empty((4, 4))
    C[0, 0] = W[0, 0] + W[1, 1] + W[2, 2]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        C[0, a + 1] = C[a + 1, 0] = W[c, b] - W[b, c]
        for e in range(3):
            C[a + 1, e + 1] = W[a, e] + W[e, a] - (a == e) * C[0, 0]
    return C
