"""Lower bounds over boxes, proven anew by dividing a box until plain bounds reach what is stated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dcreg.certificate.families import Family
from dcreg.certificate.format import INADMISSIBLE, Certificate, CertificateError

BATCH = 64  # boxes treated at once: bounds the memory of the vectorised steps
TANGENT_STEPS = 30  # attempts to find a better point for the tangent

# (boxes treated, boxes known to be needed so far)
Progress = Callable[[int, int], None]


class Proof:
    """Proves the bounds of all leaves of a certificate.

    Parameters
    ----------
    family : Family
    slack : float
        Rounding that a bound may fall short by.
    max_boxes : int
        Boxes to be bounded before the proof counts as failed.
    progress : callable, optional
        Told of the boxes treated and of those known to be needed.
    """

    def __init__(
        self, family: Family, slack: float, max_boxes: int, progress: Progress | None = None
    ) -> None:
        self.family = family
        self.slack = slack
        self.max_boxes = max_boxes
        self.progress = progress

    def run(self, c: Certificate) -> int:
        """Prove every leaf's bound; the number of boxes that took.

        Raises
        ------
        CertificateError
            Where a bound is false, or cannot be confirmed with `max_boxes` boxes.
        """
        leaves = np.arange(len(c.leaf_bounds))
        lower, upper = c.leaf_lower, c.leaf_upper
        n_boxes = 0
        while len(leaves):
            if n_boxes + len(leaves) > self.max_boxes:
                raise CertificateError(
                    f"leaf {leaves[0]}: its bound {c.leaf_bounds[leaves[0]]:.9g} could not be "
                    f"confirmed within {self.max_boxes} boxes"
                )
            unproven = []
            for at in range(0, len(leaves), BATCH):
                part = slice(at, at + BATCH)
                unproven.append(at + self._unproven(lower[part], upper[part], leaves[part], c))
                if self.progress is not None:
                    done = n_boxes + min(at + BATCH, len(leaves))
                    self.progress(done, n_boxes + len(leaves) + 2 * sum(map(len, unproven)))
            n_boxes += len(leaves)
            missing = np.concatenate(unproven)
            stuck = missing[c.leaf_reasons[leaves[missing]] == INADMISSIBLE]
            if stuck.size:
                raise CertificateError(
                    f"leaf {leaves[stuck[0]]} is stated to hold no admissible parameter, but may"
                )
            leaves = np.repeat(leaves[missing], 2)
            lower, upper = self._halves(lower[missing], upper[missing])
        return n_boxes

    def _unproven(
        self, lower: np.ndarray, upper: np.ndarray, leaves: np.ndarray, c: Certificate
    ) -> np.ndarray:
        """Indices of the boxes whose leaf's bound cannot be proven on them; cheap bounds first."""
        family = self.family
        needed = c.leaf_bounds[leaves] - self.slack
        # a sum of squares is never negative
        unproven = np.flatnonzero((needed > 0) & ~family.outside(lower, upper))
        for bound in (family.nearest_bound, self.tangent_bound, family.interval_bound):
            if unproven.size:
                found = bound(lower[unproven], upper[unproven], needed[unproven])
                unproven = unproven[found < needed[unproven]]
        for box in unproven:
            for theta in (lower[box], upper[box], 0.5 * (lower[box] + upper[box])):
                if family.admissible(theta[None])[0]:
                    family.refute(theta, needed[box], f"leaf {leaves[box]}")
        return unproven

    def tangent_bound(self, lower: np.ndarray, upper: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """max over theta0 of min over vertices v of ``E(v) - G(v - theta0)``, for each of B boxes.

        The objective of one matching is convex minus convex. With its convex part replaced by the
        tangent at any theta0 it is concave, and so least at a vertex v, where it falls short of E by
        ``sum p_ij R_i(v - theta0)``, at most G, the family's `tangent_loss`.
        """
        family = self.family
        vertices = _vertices(lower, upper)
        known = np.array([[family.known(v) for v in box] for box in vertices])
        values, exact = known[..., 0], known[..., 1] > 0
        best, losses = np.full(len(lower), -np.inf), np.empty(values.shape)
        bases = np.empty(lower.shape)
        unproven = np.arange(len(lower))
        while unproven.size:
            best[unproven], bases[unproven] = self._best_base(
                vertices[unproven], values[unproven], needed[unproven]
            )
            unproven = unproven[best[unproven] < needed[unproven]]
            losses[unproven] = family.tangent_loss(vertices[unproven] - bases[unproven, None])
            # only vertices that hold a box back need their exact value
            binding = (values[unproven] - losses[unproven] < needed[unproven, None]) & ~exact[
                unproven
            ]
            for row, at in zip(*binding.nonzero(), strict=True):
                box = unproven[row]
                values[box, at] = family.remembered_objective(vertices[box, at])
                exact[box, at] = True
            unproven = unproven[binding.any(axis=1)]
        for box in np.flatnonzero(best < needed):
            best[box] = family.exact_tangent_bound(
                vertices[box], values[box], bases[box], needed[box]
            )
        return best

    def _best_base(
        self, vertices: np.ndarray, values: np.ndarray, needed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best bound found and the theta0 it is for; stops once all boxes are proven.

        From the centre of the box theta0 moves, in ever smaller steps, towards the vertex whose term is
        the least at present.
        """
        boxes = np.arange(len(vertices))
        base = vertices.mean(axis=1)
        best, best_base = np.full(len(vertices), -np.inf), base.copy()
        for step in range(TANGENT_STEPS):
            at_vertices = values - self.family.tangent_loss(vertices - base[:, None])
            least = at_vertices.argmin(axis=1)
            found = at_vertices[boxes, least]
            better = found > best
            best[better], best_base[better] = found[better], base[better]
            if (best >= needed).all():
                break
            base += (vertices[boxes, least] - base) / (step + 2)
        return best, best_base

    def _halves(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bisect every box along its longest edge, measured by how far it moves the source."""
        axis = np.argmax((upper - lower) * self.family.weights, axis=1)
        lower, upper = np.repeat(lower, 2, axis=0), np.repeat(upper, 2, axis=0)
        rows = np.arange(len(axis))
        middle = 0.5 * (lower[2 * rows, axis] + upper[2 * rows, axis])
        upper[2 * rows, axis] = middle
        lower[2 * rows + 1, axis] = middle
        return lower, upper


def _vertices(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """(B, V, d) corners, without repeating those of axes that are flat in all boxes."""
    wide = np.flatnonzero((upper > lower).any(axis=0))
    bits = (np.arange(2 ** len(wide))[:, None] >> np.arange(len(wide))) & 1
    out = np.repeat(lower[:, None, :], len(bits), axis=1)
    out[:, :, wide] = np.where(bits, upper[:, None, wide], lower[:, None, wide])
    return out
