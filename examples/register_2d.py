"""Register two 2D clouds: a similarity, unknown pairs and some outliers."""

import numpy as np

import dcreg

rng = np.random.default_rng(0)
shape = rng.random((30, 2)) * [2.0, 1.0]
angle, scale = 2.0, 0.8
linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

source = np.vstack([shape, rng.random((5, 2)) * 2.0])  # the last five are outliers
target = shape @ linear.T + [10.0, -3.0] + 0.01 * rng.standard_normal(shape.shape)
target = rng.permutation(target)

result = dcreg.register(source, target, n_inliers=30, model="similarity2d")

print("status:", result.status, "for the", result.certificate_scope)
print("bounds:", result.lower_bound, result.upper_bound, "lower/upper:", result.bound_ratio)
print("pose (p_target = T @ [p_source, 1]):", result.T_target_source, sep="\n")
print("scale", result.scale, "RMS residual", result.rmse_matched)
print("first pairs (source row, target row):", result.assignment[:3].tolist())

assert result.status == "optimal"
assert np.allclose(result.T_target_source[:2, :2], linear, atol=0.02)
