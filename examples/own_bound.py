"""A custom bounding function in the search of the library, compared with the built-in one."""

import numpy as np

from dcreg.assignment.objective import k_assignment
from dcreg.families.protocol import SpaceBound
from dcreg.families.registry import make_bound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Budget, Evaluation, Tolerance, minimise


class BallBound(SpaceBound[Similarity2D]):
    """Each source point stays within a ball while the pose varies within its box.

    With T the pose at the box centre and h the half-widths, ``|T'(x) - T(x)|`` is at most
    ``r = |(h1, h2)| |x| + |(h3, h4)|`` for all poses T' of the box, so that
    ``|T'(x) - y| >= max(0, |T(x) - y| - r)``. One assignment of the squares bounds the box.
    """

    def _evaluate(self, boxes, cutoff):
        space, k = self.space, self.space.n_inliers
        found, halves = Evaluation.empty(boxes), 0.5 * (boxes.upper - boxes.lower)
        length, target = np.linalg.norm(space.source, axis=1), space.clouds.target.T
        for box, (centre, half) in enumerate(zip(boxes.centres, halves, strict=True)):
            T = space.pose(centre)
            moved = space.source @ T[:2, :2].T + T[:2, 2]
            distance = np.linalg.norm(moved[:, None] - target[None], axis=2)
            reach = np.hypot(half[0], half[1]) * length + np.hypot(half[2], half[3])
            nearest = np.maximum(0.0, distance - reach[:, None])
            found.lower_bounds[box] = k_assignment(nearest**2, k)[0]
        self.n_assignments += len(boxes) + space.objectives(found.thetas, found.values)
        return found


rng = np.random.default_rng(6)
source = rng.standard_normal((10, 2))
source -= source.mean(axis=0)  # pose families expect centred coordinates of unit size
target = source @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + 0.1 * rng.standard_normal(source.shape)
target -= target.mean(axis=0)
space = Similarity2D(source, target, n_inliers=10, scale_range=(0.5, 1.5))

for name, bound in (("ball", BallBound(space)), ("tight", make_bound("tight", space))):
    found = minimise(space, bound, Budget(nodes=20_000), tolerance=Tolerance(abs=0.02))
    print(f"{name}: {found.status}, {found.n_nodes} boxes, "
          f"[{found.lower_bound:.4f}, {found.upper_bound:.4f}]")  # fmt: skip
    assert found.status == "optimal"
    assert found.lower_bound <= found.upper_bound
