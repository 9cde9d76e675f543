"""Go-ICP: normalisation, search, and conversion to the units of the target."""

from __future__ import annotations

import numpy as np

from baselines._shared.cubes import with_bounds
from baselines._shared.poses import homogeneous
from baselines.contract import Baseline, Instance, Limits, Solution
from baselines.goicp.search import GoICP, Settings
from dcreg.result import Trace

SCOPE = (
    "rigid pose, many-to-one objective: sum of the n_inliers smallest squared distances from moved "
    "source points to their nearest target points"
)


class Adapter(Baseline):
    """Globally optimal trimmed nearest-neighbour registration."""

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget = limits.budget()
        frame = Frame(instance, self.options["normalise"])
        settings = self._settings(frame, instance)
        problem = GoICP(frame.source, frame.target, settings, budget)
        area = frame.unit**2
        found = with_bounds(problem.run(), lambda value: area * value)
        half = self.options["translation_half_width"]
        where = "all translations" if half is None else f"translations within {half} (its units)"
        return Solution(
            found.status,
            frame.restore(problem.incumbent.pose),
            lower_bound=found.lower_bound,
            upper_bound=found.upper_bound,
            gap_tol=area * settings.tolerance,
            certificate_scope=f"{SCOPE}; {where}",
            counters={
                "n_nodes": found.n_nodes,
                "n_translation_cubes": problem.n_translation_cubes,
            },
            trace=Trace(found.events).rows(),
        )

    def _settings(self, frame: Frame, instance: Instance) -> Settings:
        centre, half = frame.translations(
            self.options["translation_half_width"], instance.n_inliers
        )
        tolerance = self.options["mse_threshold"] * instance.n_inliers
        return Settings(
            n_kept=instance.n_inliers,
            tolerance=tolerance,
            translation_centre=centre,
            translation_half_width=half,
            cells_per_axis=self.options["cells_per_axis"],
            icp_tolerance=tolerance / 10_000,
            n_starts=self.options["start_rotations"],
            seed=instance.seed,
        )


class Frame:
    """Both clouds centred at their means and divided by one length, or unchanged.

    The source points are shuffled: terms are added until they exceed a cutoff, and distant points exceed
    it sooner than neighbours.
    """

    def __init__(self, instance: Instance, normalise: bool) -> None:
        order = np.random.default_rng(instance.seed).permutation(len(instance.source))
        source = instance.source[order]
        self.origin_source, self.origin_target, self.unit = np.zeros(3), np.zeros(3), 1.0
        if normalise:
            self.origin_source = instance.source.mean(axis=0)
            self.origin_target = instance.target.mean(axis=0)
            largest = max(
                np.abs(source - self.origin_source).max(),
                np.abs(instance.target - self.origin_target).max(),
            )
            self.unit = float(largest) if largest > 0 else 1.0
        self.source = (source - self.origin_source) / self.unit
        self.target = (instance.target - self.origin_target) / self.unit

    def translations(self, half: float | None, n_kept: int) -> tuple[np.ndarray, float]:
        """Return centre and half-width of the cube of translations; None: all that can be optimal."""
        if half is None:
            return optimal_translations(self.source, self.target, n_kept)
        return np.zeros(3), float(half)

    def restore(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose of this frame in the coordinates of the instance."""
        rotation = pose[:3, :3]
        shift = self.unit * pose[:3, 3] + self.origin_target - rotation @ self.origin_source
        return homogeneous(1.0, rotation, shift)


def contains_translation(
    instance: Instance, T_true: np.ndarray, half_width: float | None, normalise: bool = True
) -> bool:
    """Return whether Go-ICP's cube of translations contains that of a pose.

    Parameters
    ----------
    instance : Instance
    T_true : (4, 4) array
        A pose in the coordinates of the instance.
    half_width : float or None
    normalise : bool
        The options ``translation_half_width`` and ``normalise``.
    """
    frame = Frame(instance, normalise)
    moved = T_true[:3, :3] @ frame.origin_source + T_true[:3, 3]
    centre, half = frame.translations(half_width, instance.n_inliers)
    offset = np.abs((moved - frame.origin_target) / frame.unit - centre).max()
    return bool(offset <= half * (1 + 1e-9))


def optimal_translations(
    source: np.ndarray, target: np.ndarray, n_kept: int
) -> tuple[np.ndarray, float]:
    """Return centre and half-width of a cube that contains the translation of every optimal pose.

    At an optimum t = mean(partners) - R mean(kept source points). The first lies in the bounding box of
    the target. For points x_i = mean + v_i the second is no longer than |mean| plus the smaller of two
    bounds on |mean of k of the v_i|: the mean of the k longest, and, since all v_i sum to zero, the
    sum of the n - k longest over k.
    """
    mean = source.mean(axis=0)
    lengths = np.sort(np.linalg.norm(source - mean, axis=1))[::-1]
    n_trimmed = len(source) - n_kept
    shift = min(lengths[:n_kept].mean(), lengths[:n_trimmed].sum() / n_kept)
    low, high = target.min(axis=0), target.max(axis=0)
    half = (high - low).max() / 2 + np.linalg.norm(mean) + shift
    return (low + high) / 2, float(half) * (1 + 1e-9) + 1e-12
