"""Lower bounds over boxes, proven anew by dividing a box until plain bounds reach what is stated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dcreg.certificate.families import Family
from dcreg.certificate.format import INADMISSIBLE, Certificate, CertificateError

TANGENT_STEPS = 10  # attempts to find a better point for the tangent

# (boxes treated, boxes known to be needed so far)
Progress = Callable[[int, int], None]


class Proof:
    """Proves the lower bound of a certificate on all its leaves.

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
        self._bounds = [family.nearest_bound, family.interval_bound, self.tangent_bound]
        if family.is_sorted_order:  # tangents need no assignments there, and are enough
            self._bounds.remove(family.interval_bound)

    def run(self, c: Certificate) -> int:
        """Prove the stated lower bound on every leaf; the number of boxes that took.

        A leaf may state a higher bound of its own: the claim does not rest on it, so it is not proven,
        but refuted where the middle of the leaf shows it to be false.

        Raises
        ------
        CertificateError
            Where a bound is false, or cannot be confirmed with `max_boxes` boxes.
        """
        leaves = np.arange(len(c.leaf_bounds))
        lower, upper = c.leaf_lower, c.leaf_upper
        needed = c.lower_bound - self.slack
        # boxes that state more than is proven
        doubtful = c.leaf_bounds > c.lower_bound + self.slack
        n_boxes = 0
        while len(leaves):
            if n_boxes + len(leaves) > self.max_boxes:
                raise CertificateError(
                    f"leaf {leaves[0]}: that its objective is at least {c.lower_bound:.9g} could not "
                    f"be confirmed within {self.max_boxes} boxes"
                )
            is_unproven = np.zeros(len(leaves), dtype=bool)
            size = self.family.n_at_once
            for at in range(0, len(leaves), size):
                part = slice(at, at + size)
                outside = self.family.outside(lower[part], upper[part])
                self._check_inadmissible(leaves[part][~outside], c)
                is_unproven[part] = self._unproven(lower[part], upper[part], outside, needed)
                suspect = at + np.flatnonzero((is_unproven | doubtful)[part] & ~outside)
                self._refute(lower[suspect], upper[suspect], leaves[suspect], c)
                if self.progress is not None:
                    done = n_boxes + min(at + size, len(leaves))
                    self.progress(done, n_boxes + len(leaves) + 2 * int(is_unproven.sum()))
            n_boxes += len(leaves)
            leaves = np.repeat(leaves[is_unproven], 2)
            lower, upper = self._halves(lower[is_unproven], upper[is_unproven])
            doubtful = np.zeros(len(leaves), dtype=bool)  # a leaf is looked at once
        return n_boxes

    @staticmethod
    def _check_inadmissible(leaves: np.ndarray, c: Certificate) -> None:
        """None of `leaves`, which hold admissible parameters, is stated to hold none."""
        stuck = leaves[c.leaf_reasons[leaves] == INADMISSIBLE]
        if stuck.size:
            raise CertificateError(
                f"leaf {stuck[0]} is stated to hold no admissible parameter, but may"
            )

    def _unproven(
        self, lower: np.ndarray, upper: np.ndarray, outside: np.ndarray, needed: float
    ) -> np.ndarray:
        """Mask of the boxes where the objective is not known to reach `needed`; cheap bounds first."""
        # a sum of squares is never negative
        unproven = np.flatnonzero(~outside) if needed > 0 else np.empty(0, np.int64)
        for bound in self._bounds:
            if unproven.size:
                found = bound(lower[unproven], upper[unproven], needed)
                unproven = unproven[~(found >= needed)]  # what is no number proves nothing
        return np.isin(np.arange(len(lower)), unproven)

    def _refute(
        self, lower: np.ndarray, upper: np.ndarray, leaves: np.ndarray, c: Certificate
    ) -> None:
        """Refuse the certificate if the middle of a box, or else an end, beats its leaf's own bound."""
        points = np.stack([0.5 * (lower + upper), lower, upper])
        admissible = np.array([self.family.admissible(some) for some in points])
        boxes = np.flatnonzero(admissible.any(axis=0))
        thetas = points[admissible.argmax(axis=0)[boxes], boxes]
        self.family.refute(thetas, (c.leaf_bounds - self.slack)[leaves[boxes]], leaves[boxes])

    def tangent_bound(self, lower: np.ndarray, upper: np.ndarray, needed: float) -> np.ndarray:
        """max over theta0 of min over vertices v of the tangent's value there, for each of B boxes.

        The objective of one matching is convex minus convex. With its convex part replaced by the
        tangent at any theta0 it is concave, and so least at a vertex v, where it falls short of E by
        ``sum p_ij R_i(v - theta0)``, the family's `rebates`.
        """
        family = self.family
        vertices = _vertices(lower, upper)
        profiles = family.known(vertices.reshape(-1, vertices.shape[2]))
        shape = vertices.shape[:2]
        rows = np.array([profile.rows for profile in profiles]).reshape(*shape, -1)
        totals = np.array([profile.total for profile in profiles]).reshape(shape)
        exact = np.array([profile.is_exact for profile in profiles]).reshape(shape)
        curvature = family.curvature(lower, upper, needed)
        best = np.full(len(lower), -np.inf)
        bases = vertices.mean(axis=1)
        left = np.arange(len(lower))  # boxes that may be proven yet
        while left.size:
            best[left], terms, bases[left] = self._best_base(
                vertices[left], rows[left], totals[left], curvature[left], needed, bases[left]
            )
            # only vertices that hold a box back need their exact profile
            binding = np.where(exact[left], np.inf, terms).argmin(axis=1)
            holds_back = ~exact[left, binding] & (best[left] < needed)
            left, binding = left[holds_back], binding[holds_back]
            for box, at in zip(left, binding, strict=True):
                rows[box, at], totals[box, at], exact[box, at] = family.solved(vertices[box, at])
        return np.minimum(best, needed)

    def _best_base(
        self,
        vertices: np.ndarray,
        rows: np.ndarray,
        totals: np.ndarray,
        curvature: np.ndarray,
        needed: float,
        base: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The best bound found, the values at the vertices, and the theta0 that gave them.

        From `base` theta0 moves, in ever smaller steps, towards the vertex whose term is the least at
        present.
        """
        best, best_base = np.full(len(vertices), -np.inf), base.copy()
        best_terms = np.empty(vertices.shape[:2])
        left = np.arange(len(vertices))  # boxes not proven yet
        for step in range(TANGENT_STEPS):
            rebates = self.family.rebates(vertices[left] - base[left, None], curvature[left])
            terms = self.family.tangent_terms(rows[left], totals[left], rebates)
            least = terms.argmin(axis=1)
            found = terms[np.arange(len(left)), least]
            better = found > best[left]
            improved = left[better]
            best[improved], best_terms[improved] = found[better], terms[better]
            best_base[improved] = base[improved]
            base[left] += (vertices[left, least] - base[left]) / (step + 2)
            left = left[best[left] < needed]
            if not left.size:
                break
        return best, best_terms, best_base

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
