"""Write a certificate to disk and verify it independently of the search."""

import tempfile
from pathlib import Path

import numpy as np

import dcreg

rng = np.random.default_rng(4)
source = rng.random((12, 2))
target = source + [2.0, 1.0] + 0.01 * rng.standard_normal(source.shape)

result = dcreg.register(
    source, target, n_inliers=12, model="similarity2d", options=dcreg.SolveOptions(certificate=True)
)

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "proof.npz"
    result.write_certificate(path)
    report = dcreg.verify(path, source, target)
    other = dcreg.verify(path, source, target + 1e-3)

print(report.statement)
print(f"{report.n_leaves} leaves, {report.n_boxes} boxes bounded again")
print("with other clouds:", other.reason)

assert report.accepted
assert not other.accepted
