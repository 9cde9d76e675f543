"""Attributes: grey values decide the pose of a square board, which looks the same after four turns."""

import numpy as np

import dcreg

rng = np.random.default_rng(1)
board = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
grey = rng.random(36)  # from 0 to 1

turn = np.array([[0.0, -1.0], [1.0, 0.0]])  # by 90 degrees
scan = board @ turn.T + 0.05 * rng.standard_normal(board.shape)
scan_grey = grey + 0.02 * rng.standard_normal(36)

settings = {"n_inliers": 36, "model": "similarity2d", "scale_range": (1, 1)}
attributes = dcreg.Attributes(grey, scan_grey, scale=0.05 / 0.02)  # noise of points, noise of grey
plain = dcreg.register(board, scan, **settings)
compared = dcreg.register(board, scan, **settings, attributes=attributes)
for name, result in (("points", plain), ("points and grey values", compared)):
    print(
        f"{name}: {result.status}, rotation {result.rotation_deg:.1f} deg, {result.n_nodes} boxes"
    )

assert (compared.assignment[:, 0] == compared.assignment[:, 1]).all()
print(f"RMS residual {compared.rmse_matched:.3f}, attribute cost {compared.attribute_cost:.3f}")
