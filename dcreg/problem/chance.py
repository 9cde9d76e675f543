"""How many choices of few pairs of unrelated clouds fit as well by chance."""

from __future__ import annotations

import math

from dcreg.problem.geometry import rms_radius, rounding_error
from dcreg.problem.problem import Problem


def log_chance_fits(problem: Problem, k: int, objective: float) -> float:
    """Return the log of the expected number of fits as good as this one between unrelated clouds.

    The expected number is the number of choices of k pairs times the probability that one choice fits,
    the number of false alarms of a-contrario methods (Moisan and Stival 2004). The points of unrelated
    clouds are independent and uniform in a cube with the standard deviation of the smaller cloud. The k
    target points of a choice fit if they lie in a tube around all images of the source points. The
    cross-section of the tube is a ball whose squared radius is the objective.

    Parameters
    ----------
    problem : Problem
        Its own number of pairs does not matter.
    k : int
        Number of pairs, at least the dimension.
    objective : float
        Sum of squared residuals of the k pairs.
    """
    d, n, m = problem.dim, len(problem.source), len(problem.target)
    variance = min(rms_radius(problem.source), rms_radius(problem.target)) ** 2 / d
    if variance == 0.0:
        return -math.inf
    low, high = problem.scale_range
    n_linear = d * (d - 1) // 2 + (low < high)  # parameters of rotation and scale
    rotations = 8.0 * math.pi**2 if d == 3 else 2.0 * math.pi
    # volume of all images: translations within the cube; rotations and scales weighted by how far they
    # move the points
    images = 0.5 * d * (math.log(k) + math.log(12.0)) + 0.5 * n_linear * math.log(2.0 * k)
    images += math.log(rotations) + (math.log(math.log(high / low)) if low < high else 0.0)
    free = d * k - d - n_linear
    squared_radius = (objective + rounding_error(problem.source, problem.target, k)) / variance
    ball = 0.5 * free * math.log(math.pi * squared_radius) - math.lgamma(0.5 * free + 1.0)
    chosen = math.lgamma(n + 1) - math.lgamma(n - k + 1) - math.lgamma(k + 1)
    chosen += math.lgamma(m + 1) - math.lgamma(m - k + 1)
    if problem.candidates is not None:
        chosen += k * math.log(problem.candidates.mean())
    return chosen + images + ball - 0.5 * d * k * math.log(12.0)
