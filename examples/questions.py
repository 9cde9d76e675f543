"""Ask about a pose: is it optimal, is it the only one, and does any pose fit well enough?"""

import numpy as np
from scipy.spatial.transform import Rotation

import dcreg

rng = np.random.default_rng(3)
source = rng.standard_normal((30, 3)) * [0.5, 0.3, 0.2]
turn = Rotation.from_rotvec([0.0, 0.0, 0.9]).as_matrix()
target = rng.permutation(source @ turn.T + [1.0, 2.0, 0.5] + 0.005 * rng.standard_normal((30, 3)))
problem = {"n_inliers": 30, "model": "rigid3d"}

# is the pose of another program optimal? This one is half a degree off
rough = np.eye(4)
rough[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.91]).as_matrix()
rough[:3, 3] = [1.0, 2.0, 0.5]
judged = dcreg.certify(source, target, rough, **problem)
print(judged.verdict, f"by at most {judged.max_improvement / judged.objective:.0%}")

# is the best pose the only one?
found = dcreg.alternatives(source, target, **problem)
print(found.answer)

# is there a pose with an RMS residual of at most 0.004?
refuted = dcreg.register(source, target, max_rms=0.004, **problem)
print(refuted.status)

# the rotation is about the z-axis: four degrees of freedom remain
level = dcreg.register(
    source, target, pose_range=dcreg.PoseRange(axis=(0, 0, 1), max_angle=90), **problem
)
print(level.status, f"{level.rotation_deg:.1f} degrees, {level.n_nodes} boxes")

assert judged.verdict == "improvable"
assert found.is_unique
assert refuted.status == "refuted"
assert np.allclose(level.rotation, turn, atol=0.02)
