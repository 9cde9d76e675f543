"""Feasible pairs: exclude pairs in advance, here by a descriptor (a colour) of each point."""

import numpy as np

import dcreg

rng = np.random.default_rng(3)
source = rng.random((40, 2))
colour = rng.integers(0, 4, size=40)
target = source @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + 0.01 * rng.standard_normal(source.shape)
target = np.vstack([target, 2.0 * rng.random((20, 2)) - 1.0])  # clutter
target_colour = np.concatenate([colour, rng.integers(0, 4, size=20)])

mask = colour[:, None] == target_colour[None, :]  # (n, m): may i match j?

settings = {"n_inliers": 36, "model": "similarity2d", "rel_gap": 0.0, "abs_gap": 1e-3}
free = dcreg.register(source, target, **settings)
gated = dcreg.register(source, target, **settings, candidates=mask)
for name, result in (("all pairs", free), ("feasible pairs", gated)):
    print(f"{name}: {result.status}, {result.n_nodes} boxes, RMS {result.rmse_matched:.4f}")

assert mask[tuple(gated.assignment.T)].all()
assert gated.n_nodes < free.n_nodes
