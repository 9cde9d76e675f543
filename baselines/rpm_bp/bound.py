"""The convex QP of RPM-BP: phi tied to theta by the envelopes of its squares and products.

Let theta = centre + half_widths * z with z in [-1, 1]^4. Squares with a positive coefficient stay. A
square with a negative coefficient is replaced by its secant, -z_a^2 >= -1, and a product by its
envelope

    c z_a z_b >= |c| (|z_a + sign(c) z_b| - 1) >= omega (z_a + sign(c) z_b) - |c|,   |omega| <= |c|.

For fixed omega the programme separates into the four z_a. Its closed form is a lower bound for any omega.
The QP solver only proposes the best omega, so its tolerances cannot invalidate the bound.
"""

from __future__ import annotations

import clarabel
import numpy as np
from scipy import sparse

from baselines._shared.relaxations import MinimumOverBox, SubstitutedBound

# The products t_a t_b of phi2 and phi3: a, b, index of phi, coefficient
PRODUCTS = ((0, 2, 1, 1.0), (1, 3, 1, 1.0), (0, 3, 2, 1.0), (1, 2, 2, -1.0))
_FIRST, _SECOND = np.array([p[0] for p in PRODUCTS]), np.array([p[1] for p in PRODUCTS])
_PHI, _FACTOR = np.array([p[2] for p in PRODUCTS]), np.array([p[3] for p in PRODUCTS])
_N = len(PRODUCTS)


class BilinearBound(SubstitutedBound):
    """Lower bound of RPM-BP (reconstructed), never below R1 of RPM-HTB on the same box."""

    def minimum_over_box(self) -> MinimumOverBox:
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        k = float(self.space.n_inliers)

        def minimum(
            beta: np.ndarray, gamma: np.ndarray, lower: np.ndarray, upper: np.ndarray
        ) -> tuple[float, np.ndarray]:
            centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
            weights = np.array([gamma[0], gamma[0], k, k])  # of the squares
            products = _FACTOR * gamma[_PHI]
            constant = beta @ centre + weights @ centre**2
            constant += products @ (centre[_FIRST] * centre[_SECOND])
            linear = beta + 2.0 * weights * centre
            np.add.at(linear, _FIRST, products * centre[_SECOND])
            np.add.at(linear, _SECOND, products * centre[_FIRST])
            linear *= half
            squares = weights * half**2
            products = products * half[_FIRST] * half[_SECOND]
            constant += np.minimum(squares, 0.0).sum() - np.abs(products).sum()
            squares = np.maximum(squares, 0.0)
            omega = best_multipliers(squares, linear, products, settings)
            value, z = separable(squares, linear, products, omega)
            return constant + value, centre + half * z

        return minimum


def separable(
    squares: np.ndarray, linear: np.ndarray, products: np.ndarray, omega: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the minimum of ``squares.z^2 + linear.z + sum omega (z_a + sign z_b)``, and its z."""
    slope = linear.copy()
    np.add.at(slope, _FIRST, omega)
    np.add.at(slope, _SECOND, omega * _sign(products))
    with np.errstate(divide="ignore", invalid="ignore"):
        free = np.where(squares > 0.0, -0.5 * slope / squares, -np.sign(slope))
    z = np.clip(np.nan_to_num(free), -1.0, 1.0)
    return float(squares @ z**2 + slope @ z), z


def best_multipliers(
    squares: np.ndarray,
    linear: np.ndarray,
    products: np.ndarray,
    settings: clarabel.DefaultSettings,
) -> np.ndarray:
    """Return the best omega: duals of ``w >= +-(z_a + sign z_b)`` in a QP over (z, w)."""
    reach = np.abs(products)
    scale = max(float(np.abs(linear).max()), float(squares.max()), float(reach.max()))
    if scale == 0.0 or reach.max() == 0.0:
        return np.zeros(_N)
    pairs = np.zeros((_N, 4))
    pairs[np.arange(_N), _FIRST] = 1.0
    pairs[np.arange(_N), _SECOND] = _sign(products)
    box = np.eye(4, 4 + _N)
    rows = np.vstack([np.hstack([pairs, -np.eye(_N)]), np.hstack([-pairs, -np.eye(_N)]), box, -box])
    solver = clarabel.DefaultSolver(
        sparse.diags(np.concatenate([2.0 * squares, np.zeros(_N)]) / scale, format="csc"),
        np.concatenate([linear, reach]) / scale,
        sparse.csc_matrix(rows),
        np.concatenate([np.zeros(2 * _N), np.ones(8)]),
        [clarabel.NonnegativeConeT(len(rows))],
        settings,
    )
    duals = scale * np.array(solver.solve().z)
    omega = np.nan_to_num(duals[:_N] - duals[_N : 2 * _N])
    return np.clip(omega, -reach, reach)


def _sign(products: np.ndarray) -> np.ndarray:
    return np.where(products >= 0.0, 1.0, -1.0)
