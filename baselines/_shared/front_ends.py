"""Front ends: from two point sets to putative pairs. A front end is part of a method's identity.

``fpfh-mutual``
    Open3D's FPFH features; pairs of points that are mutual nearest neighbours in feature space. Radii
    are multiples of the target's median point spacing, the same for both sets. 3D only.
``norm-signature``
    Two signatures of a point that are invariant to motion: the sorted distances to its nearest
    neighbours, and quantiles of its distances to all points of the set. In 2D they are divided by their
    mean and so invariant to scale. The first tolerates clutter, the second noise. Every source point is
    paired with the `signature_neighbours` most similar target points by each. 2D and 3D.
``all-pairs``
    Every source point with every target point. If these exceed `max_pairs`, only an evenly spread
    subset of the source points is paired, and the message says so. 2D and 3D.
``oracle``
    All true pairs and random pairs; the latter are the share `oracle_outliers` of the whole. The harness
    makes them from the true pose, only for methods with this front end. It favours a method and shows
    its results with good correspondences. 2D and 3D.

``shared-mutual``, ``shared-nearest``, ``shared-several``
    Matches that come with the instance, the same for all methods: nearest neighbours by FPFH features
    of the whole clouds, computed once by the harness with the settings of the dataset. They are the
    mutual ones, the nearest one of every source point, or its five nearest. 3D only.

``own``
    The method's own front end on the clouds of the instance, for methods that have one. 3D only.

No front end returns more than `max_pairs` pairs: the least similar are dropped, and the message says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from baselines._shared import open3d_clouds
from baselines._shared.poses import median_spacing
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from dcreg.problem.geometry import farthest_point_order, fit_pose
from dcreg.search import Budget
from dcreg.status import Status

SHARED = ("shared-mutual", "shared-nearest", "shared-several")
OWN = "own"  # of methods with `CorrespondenceMethod.has_own_front_end`
FRONT_ENDS = ("fpfh-mutual", "norm-signature", "all-pairs", "oracle", *SHARED)
# Options that a single front end uses.
OPTIONS_OF = {
    "fpfh-mutual": ("normal_radius", "feature_radius"),
    "norm-signature": ("signature_neighbours",),
    "oracle": ("oracle_outliers",),
}
SEVERAL = 5  # matches of a source point in shared-several
OPEN3D = "pip install open3d; on a bare Debian also apt-get install libusb-1.0-0 libgl1 libegl1"
Viewpoint = tuple[float, float, float] | None
SIGNATURE_NEAREST = 8  # neighbours whose distances enter a signature
SIGNATURE_QUANTILES = np.linspace(0.1, 0.9, 9)


class FrontEndError(Exception):
    """A front end has no pairs for this instance; the message says why."""


@dataclass(frozen=True)
class Putative:
    """Rows (source index, target index), and a note for the reader."""

    pairs: np.ndarray
    note: str = ""


@dataclass(frozen=True)
class Estimate:
    """The result of a method for given pairs: a pose or None, and whether it ended by itself."""

    pose: np.ndarray | None
    finished: bool = True
    message: str = ""
    extra: dict[str, float] = field(default_factory=dict)


def unavailable(front_end: str) -> str | None:
    """Return None if the front end can run here, otherwise the reason and how to get it."""
    if front_end != "fpfh-mutual":
        return None
    try:
        import open3d  # noqa: F401
    except Exception as error:  # a missing system library is an OSError or ImportError
        return f"front end fpfh-mutual needs open3d: {error}. {OPEN3D}"
    return None


def missing_matches(instance: Instance, front_end: str | None) -> str | None:
    """Return why a shared front end has no matches for the instance; None for any other case."""
    if front_end in SHARED and front_end not in instance.matches:
        return f"front end {front_end}: the dataset of this instance has no shared matches"
    return None


def putative_pairs(instance: Instance, options: dict[str, Any]) -> Putative:
    """Return pairs from the front end and settings in `options`, the most similar first."""
    front_end, most = options["front_end"], options["max_pairs"]
    if front_end == "all-pairs":
        return all_pairs(instance, most)
    if front_end == "oracle":
        if instance.oracle_pairs is None:
            raise FrontEndError(
                "front end oracle: this instance has no oracle pairs; the harness makes them only for "
                "methods with the option front_end: oracle"
            )
        pairs = instance.oracle_pairs
    elif front_end in SHARED:
        if reason := missing_matches(instance, front_end):
            raise FrontEndError(reason)
        pairs = instance.matches[front_end]
    elif front_end == "norm-signature":
        pairs = norm_signature(instance, options["signature_neighbours"])
    else:
        pairs = fpfh_mutual(instance, options["normal_radius"], options["feature_radius"])
    if len(pairs) <= most:
        return Putative(pairs)
    return Putative(pairs[:most], f"{front_end}: {most} of {len(pairs)} pairs kept (max_pairs)")


def fpfh_mutual(instance: Instance, normal_radius: float, feature_radius: float) -> np.ndarray:
    """Return mutual nearest FPFH matches; radii in median spacings of the target."""
    spacing = median_spacing(instance.target)
    radii = normal_radius * spacing, feature_radius * spacing
    return _nearest_features(instance.source, instance.target, 1, radii)["shared-mutual"]


def shared_matches(
    source: np.ndarray, target: np.ndarray, radii: tuple[float, float], viewpoint: Viewpoint = None
) -> dict[str, np.ndarray]:
    """Return the matches of the shared front ends, the most similar first.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
        The whole clouds.
    radii : (of normals, of features)
        In the unit of the clouds.
    viewpoint : (3,) floats, optional
        Position of the sensor in the frame of either cloud; normals are oriented towards it.
    """
    return _nearest_features(source, target, SEVERAL, radii, viewpoint)


def _nearest_features(
    source: np.ndarray,
    target: np.ndarray,
    several: int,
    radii: tuple[float, float],
    viewpoint: Viewpoint = None,
) -> dict[str, np.ndarray]:
    features = [_fpfh(points, radii, viewpoint) for points in (source, target)]
    several = min(several, len(target))
    distances, to_target = cKDTree(features[1]).query(features[0], k=range(1, several + 1))
    to_source = cKDTree(features[0]).query(features[1])[1]
    rows = np.arange(len(source))
    is_mutual = to_source[to_target[:, 0]] == rows
    nearest = np.argsort(distances[:, 0], kind="stable")
    mutual = nearest[is_mutual[nearest]]
    # order: mutual, then all nearest, then second nearest, ...
    ranks = np.tile(np.arange(several), (len(source), 1))
    ranks[is_mutual, 0] = -1
    order = np.lexsort([distances.ravel(), ranks.ravel()])
    return {
        "shared-mutual": np.column_stack([mutual, to_target[mutual, 0]]),
        "shared-nearest": np.column_stack([nearest, to_target[nearest, 0]]),
        "shared-several": np.column_stack([order // several, to_target.ravel()[order]]),
    }


def norm_signature(instance: Instance, neighbours: int) -> np.ndarray:
    """Pair every source point with the most similar target points by each signature."""
    size = min(len(instance.source), len(instance.target)) - 1
    if size < 1:
        return np.empty((0, 2), dtype=np.int64)
    free_scale = instance.scale_range[0] < instance.scale_range[1]
    both = zip(
        *(
            _signatures(points, min(SIGNATURE_NEAREST, size), free_scale)
            for points in (instance.source, instance.target)
        ),
        strict=True,
    )
    k = min(neighbours, len(instance.target))
    rows, columns, unlikeness = [], [], []
    for source, target in both:
        distances, nearest = cKDTree(target).query(source, k=range(1, k + 1))
        rows.append(np.repeat(np.arange(len(source)), k))
        columns.append(nearest.ravel())
        unlikeness.append(distances.ravel() / max(float(np.median(distances)), 1e-300))
    pairs = np.column_stack([np.concatenate(rows), np.concatenate(columns)])
    pairs = pairs[np.argsort(np.concatenate(unlikeness), kind="stable")]
    _, first = np.unique(pairs, axis=0, return_index=True)
    return pairs[np.sort(first)]


def all_pairs(instance: Instance, max_pairs: int) -> Putative:
    """Return all pairs, of a subset of the source points if they are too many."""
    n, m = len(instance.source), len(instance.target)
    kept = max_pairs // m
    if kept < min(n, instance.dim):
        raise FrontEndError(
            f"all-pairs: {n * m} pairs exceed max_pairs = {max_pairs}, which leaves {kept} of {n} source "
            "points; increase max_pairs or downsample the clouds"
        )
    rows, note = np.arange(n), ""
    if kept < n:
        first = int(np.argmax(((instance.source - instance.source.mean(axis=0)) ** 2).sum(axis=1)))
        rows = np.sort(farthest_point_order(instance.source, kept, first))
        note = f"all-pairs: {kept} of {n} source points paired (max_pairs)"
    pairs = np.column_stack([np.repeat(rows, m), np.tile(np.arange(m), len(rows))])
    return Putative(pairs, note)


def oracle_pairs(true_pairs: np.ndarray, n: int, m: int, outliers: float, seed: int) -> np.ndarray:
    """Return all true pairs and a share `outliers` of random false pairs, in random order."""
    generator = np.random.default_rng(seed)
    true = np.asarray(true_pairs, dtype=np.int64)
    wanted = round(len(true) * outliers / (1 - outliers))
    wrong = np.setdiff1d(np.arange(n * m), true[:, 0] * m + true[:, 1])
    drawn = generator.choice(wrong, size=min(wanted, len(wrong)), replace=False)
    return generator.permutation(np.vstack([true, np.column_stack([drawn // m, drawn % m])]))


def _fpfh(points: np.ndarray, radii: tuple[float, float], viewpoint: Viewpoint) -> np.ndarray:
    """Return the FPFH features of every point, (n, 33)."""
    import open3d

    open3d_clouds.quiet()
    search = open3d.geometry.KDTreeSearchParamHybrid
    normal_radius, feature_radius = radii
    cloud = open3d_clouds.cloud(points)
    cloud.estimate_normals(search(radius=normal_radius, max_nn=30))
    if viewpoint is not None:
        cloud.orient_normals_towards_camera_location(viewpoint)
    # its stub declares the optional `indices` as required
    describe: Any = open3d.pipelines.registration.compute_fpfh_feature
    features = describe(cloud, search(radius=feature_radius, max_nn=100))
    return np.asarray(features.data).T


def _signatures(
    points: np.ndarray, nearest: int, free_scale: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return two signatures of every point: its nearest distances, and those with quantiles of all."""
    distances = cdist(points, points)
    near = np.sort(np.partition(distances, nearest, axis=1)[:, : nearest + 1], axis=1)[:, 1:]
    far = np.hstack([near, np.quantile(distances, SIGNATURE_QUANTILES, axis=1).T])
    if not free_scale:
        return near, far
    means = (signature.mean(axis=1, keepdims=True) for signature in (near, far))
    near_mean, far_mean = (np.where(mean > 0, mean, 1.0) for mean in means)
    return near / near_mean, far / far_mean


def _surface(instance: Instance) -> Instance:
    """Return a wavy surface for the warm-up: some libraries crash on clouds without descriptors."""
    x, y = np.meshgrid(np.linspace(0.0, 6.0, 60), np.linspace(0.0, 6.0, 60))
    points = np.column_stack([x.ravel(), y.ravel(), (np.sin(2.0 * x) * np.cos(y * y)).ravel()])
    return replace(tiny(instance), source=points, target=points + 0.3, noise_bound=0.2)


class CorrespondenceMethod(Baseline):
    """A method over putative pairs from a front end.

    A subclass defines `estimate`, or `solve_pairs` if it returns a pose only. With `has_own_front_end`
    it also defines `solve_clouds`.
    """

    has_own_front_end = False

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        front_end = self.options["front_end"]
        known = (*FRONT_ENDS, *[OWN] * self.has_own_front_end)
        if front_end not in known:
            raise ValueError(f"option front_end = {front_end!r}; choose one of {', '.join(known)}")

    def idle_options(self) -> dict[str, str]:
        front_end = self.options["front_end"]
        idle = {
            option: f"with front_end: {front_end}"
            for owner, options in OPTIONS_OF.items()
            if owner != front_end
            for option in options
        }
        if front_end == OWN:
            idle |= dict.fromkeys(("max_pairs", "threshold"), "with front_end: own")
        return {**super().idle_options(), **idle}

    def available(self) -> str | None:
        return super().available() or unavailable(self.options["front_end"])

    def supports(self, instance: Instance) -> str | None:
        if reason := super().supports(instance):
            return reason
        front_end = self.options["front_end"]
        if front_end == "fpfh-mutual" and instance.dim != 3:
            return f"front end fpfh-mutual does not support {instance.model}"
        return missing_matches(instance, front_end)

    def warm_up(self, instance: Instance) -> None:
        if self.options["front_end"] == OWN:
            self.solve_clouds(_surface(instance))
            return
        small = tiny(instance)
        if self.options["front_end"] not in ("oracle", *SHARED):
            putative_pairs(small, self.options)
        rows = np.arange(len(small.source))
        self.estimate(small, np.column_stack([rows, rows]), Budget(time_s=30.0))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget = limits.budget()
        if self.options["front_end"] == OWN:
            return self._solution_of_clouds(instance, budget)
        try:
            putative = putative_pairs(instance, self.options)
        except FrontEndError as error:
            return Solution(Status.FAILED, None, str(error))
        pairs = putative.pairs
        counters = {"n_correspondences": len(pairs)}
        if len(pairs) < instance.dim:
            message = f"{len(pairs)} correspondences; a pose needs at least {instance.dim}"
            return Solution(Status.FAILED, None, message, counters=counters)
        found = self.estimate(instance, pairs, budget)
        late = budget.is_over
        notes = [putative.note, found.message]
        pose, status = found.pose, Status.CONVERGED
        if not found.finished and pose is None:
            pose = fit_pose(
                instance.source[pairs[:, 0]], instance.target[pairs[:, 1]], instance.scale_range
            )
            notes.append(
                "stopped at the time limit; the pose is the least-squares fit to all pairs"
            )
            status = Status.TIME_LIMIT
        elif pose is None:
            notes.append("the method found no consistent correspondences")
            status = Status.FAILED
        elif not found.finished:
            notes.append("stopped at the time limit")
            status = Status.TIME_LIMIT
        elif late:
            notes.append("the solver ended after the time limit")
            status = Status.TIME_LIMIT
        return Solution(
            status, pose, "; ".join(filter(None, notes)), counters=counters, extra=found.extra
        )

    def _solution_of_clouds(self, instance: Instance, budget: Budget) -> Solution:
        pose, n_pairs = self.solve_clouds(instance)
        counters = {"n_correspondences": n_pairs}
        if pose is None:
            message = "the method found no consistent correspondences"
            return Solution(Status.FAILED, None, message, counters=counters)
        if budget.is_over:
            message = "the solver ended after the time limit"
            return Solution(Status.TIME_LIMIT, pose, message, counters=counters)
        return Solution(Status.CONVERGED, pose, "its own front end", counters=counters)

    def solve_clouds(self, instance: Instance) -> tuple[np.ndarray | None, int]:
        """Return the pose, or None, by the method's own front end, and its number of pairs."""
        raise NotImplementedError(f"{type(self).__name__} has no front end of its own")

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        """Return the pose from these pairs within the budget, with notes.

        The front end has used a part of the budget, which may be over before the first step.
        """
        return Estimate(self.solve_pairs(instance, pairs, budget))

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        """Return the pose from these pairs, or None."""
        raise NotImplementedError(f"{type(self).__name__} must define estimate or solve_pairs")
