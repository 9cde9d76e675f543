"""Compiled linearisation of the products in the 2D objective: see `baselines._shared.relaxations`."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.families.dc.kernels import termwise_envelopes as envelopes
from dcreg.families.dc.kernels import termwise_plane as plane
from dcreg.jit import jit


@jit
def linearise(features, low, high, k, lower, upper, constants, beta, gamma):
    """Constant with the least assignment, slopes in theta and in phi, of every box."""
    n, m = features.shape[1], features.shape[2]
    cost, alpha = np.empty((n, m)), np.empty(plane.N_FEATURES)
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        alpha[:] = 0.0
        beta[box] = 0.0
        constant = 0.0
        for f in range(3):
            least, most = _phi_range(f, lo, up)
            cg, gamma[box, f], c0 = envelopes.relax_product(
                1.0 if f == 0 else 2.0, low[f], high[f], least, most
            )
            alpha[f] += cg
            constant += c0
        for row in range(plane.BILINEAR.shape[0]):
            f, a = plane.BILINEAR[row, 0], plane.BILINEAR[row, 1]
            cg, ct, c0 = envelopes.relax_product(-2.0, low[f], high[f], lo[a], up[a])
            alpha[f] += cg
            beta[box, a] += ct
            constant += c0
        for i in range(n):
            for j in range(m):
                total = features[7, i, j]
                for f in range(plane.N_FEATURES):
                    total += alpha[f] * features[f, i, j]
                cost[i, j] = total
        value, _ = k_assignment(cost, k, np.zeros(1, np.uint8))
        constants[box] = value + constant
    return lower.shape[0]


@jit
def _phi_range(f, lower, upper):
    if f == 0:
        pl, ph = envelopes.product_range(0, 0, lower, upper)
        ql, qh = envelopes.product_range(1, 1, lower, upper)
    elif f == 1:
        pl, ph = envelopes.product_range(0, 2, lower, upper)
        ql, qh = envelopes.product_range(1, 3, lower, upper)
    else:
        pl, ph = envelopes.product_range(0, 3, lower, upper)
        qh, ql = envelopes.product_range(1, 2, lower, upper)
        ql, qh = -ql, -qh
    return pl + ql, ph + qh
