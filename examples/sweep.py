"""Unknown number of inliers: solve for several numbers of pairs, with bounds for each."""

import numpy as np

import dcreg

rng = np.random.default_rng(2)
source = rng.random((24, 2))
target = source + 3.0 + 0.01 * rng.standard_normal(source.shape)
target[18:] = rng.random((6, 2)) + 3.0  # six outliers

found = dcreg.sweep(source, target, [12, 15, 18, 20, 22, 24], model="similarity2d")

print("pairs  bounds on the RMS residual    proven by the search for")
for row in found.rows():
    print(f"{row['n_inliers']:5d}  {row['rms_lower']:.4f} {row['rms']:.4f}  {row['proven_by']}")
print("suggested number of pairs (not certified):", found.suggested_n_inliers)

assert found.status == "optimal"
assert found.suggested_n_inliers == 18
