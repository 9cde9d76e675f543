"""One check per question: solve a small problem, and return what its answer states wrongly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import dcreg
from dcreg.problem import apply_pose, largest_matching, nearest_rotation, scale_of
from dcreg.status import Status
from tests.questions.draws import noisy
from tests.questions.problems import TIME_LIMIT, Small, small

# Largest relative error of a variance. That of 2,000 draws is below 0.12 in each direction; 0.2 is four
# standard deviations more.
SPREAD = 0.2
# (answer in a word, faults)
Checked = tuple[str, list[str]]


def check_max_rms(number: int) -> Checked:
    """Is there a pose with at most this residual, among all, in a range or of feasible pairs?"""
    one = small(number, ("", "candidates", "range", "candidates")[number % 4])
    p, eps = one.problem, one.rounding()
    optimum = min(value for value, _ in one.fits())
    factor = (0.5, 0.9, 0.99, 1.01, 1.1, 2.0)[number // 3 % 6]
    tau = factor * np.sqrt((optimum + 100 * eps) / p.n_inliers)
    found = dcreg.register(p.source, p.target, max_rms=tau, **one.keywords)
    threshold, faults = p.n_inliers * tau**2, []
    if found.status is Status.REFUTED and optimum <= threshold - eps:
        faults.append(f"refuted, but {optimum} <= {threshold}")
    is_met = found.objective <= threshold
    if is_met and optimum > threshold + eps:
        faults.append(f"pose with {found.objective}, but the optimum is {optimum} > {threshold}")
    if found.lower_bound > optimum + eps:
        faults.append(f"lower bound {found.lower_bound} above the optimum {optimum}")
    return ("met" if is_met else found.status.value), faults


def check_certify(number: int) -> Checked:
    """Is this pose optimal, of all or in a range? It is the fit to some matching, or a rough one."""
    one = small(number, "range" if number % 4 == 1 else "")
    p, eps = one.problem, one.rounding()
    fits = sorted(one.fits(), key=lambda fit: fit[0])
    rng = np.random.default_rng([8, number])
    T = fits[min(int(rng.integers(4)) ** 2, len(fits) - 1)][1].copy()
    if number % 5 == 0 and p.pose_range is None:
        T[:-1, -1] += 0.05 * rng.standard_normal(p.dim)
    found = dcreg.certify(p.source, p.target, T, **one.keywords)
    value, _ = dcreg.objective(p.source, p.target, T, p.n_inliers)
    optimum, faults = fits[0][0], []
    if abs(found.objective - value) > eps:
        faults.append(f"objective {found.objective}, but it is {value}")
    if found.lower_bound > optimum + eps:
        faults.append(f"lower bound {found.lower_bound} above the optimum {optimum}")
    if found.verdict == "optimal" and value > optimum + found.gap_tol * (1 + 1e-5) + eps:
        faults.append(f"optimal, but {value} exceeds the optimum {optimum} by more than the gap")
    if found.verdict == "improvable" and found.result.objective >= value:
        faults.append("improvable, but the pose given is no worse")
    return found.verdict, faults


def check_alternatives(number: int) -> Checked:
    """Are these all poses that are nearly as good? Every good fit must be near a listed pose.

    Most open answers have fewer pairs than source points. In 2D, two pairs fit exactly at more poses than
    are listed; in 3D, the bounds near the boundary of the region need more time.
    """
    one = small(number)
    p, eps = one.problem, one.rounding()
    ratio = (1.0, 1.2, 1.5, 2.0)[number // 3 % 4]
    isolated = 0.3 if number % 5 == 0 else None
    found = dcreg.alternatives(p.source, p.target, ratio=ratio, isolated=isolated, **one.keywords)
    listed, faults = list(found.poses.values()), []
    for at, T in enumerate(listed[1:], 1):
        value, _ = dcreg.objective(p.source, p.target, T, p.n_inliers)
        if value > found.threshold + eps:
            faults.append(f"pose {at} has the objective {value} > {found.threshold}")
        if min(_apart(p.source, T, other) for other in listed[:at]) < found.min_displacement * (
            1 - 1e-6
        ):
            faults.append(f"pose {at} is not distinct")
    reached = max(found.lower_bound, found.threshold if found.is_complete else 0.0)
    for value, T in one.fits():
        gap = min(_apart(p.source, T, other) for other in listed)
        if value <= reached - eps and gap > found.min_displacement * (1 + 1e-6):
            faults.append(f"a pose with {value} <= {reached} is missing ({gap} away)")
            break
    faults += _beyond(one, found.min_displacement, listed, found.lower_bound)
    words = "unique" if found.is_unique else f"{'all' if found.is_complete else 'at least'}"
    return words, faults


def _beyond(one: Small, distance: float, listed: list[np.ndarray], lower_bound: float) -> list[str]:
    """Compare the lower bound with random poses just beyond the listed ones, stationary or not."""
    p, rng = one.problem, np.random.default_rng([9, one.number])
    d, eye = p.dim, np.eye(p.dim)
    for _ in range(60):
        T = listed[int(rng.integers(len(listed)))]
        step, size = 0.3 * rng.standard_normal((d, d)), rng.uniform(1.0, 2.0) * distance
        shift, growth = 0.3 * rng.integers(2) * rng.standard_normal((2, d))
        moved, scale = T.copy(), scale_of(T)
        for _ in range(30):  # scale the step until the displacement is as wanted
            ratio = np.clip(scale * (1.0 + growth[0]), *p.scale_range) / scale
            moved[:d, :d] = ratio * nearest_rotation(eye + step - step.T) @ T[:d, :d]
            moved[:d, d] = T[:d, d] + shift
            factor = size / max(_apart(p.source, moved, T), 1e-12)
            step, shift, growth = factor * step, factor * shift, factor * growth
        if min(_apart(p.source, moved, other) for other in listed) > distance:
            value, _ = dcreg.objective(p.source, p.target, moved, p.n_inliers)
            if value < lower_bound - one.rounding():
                return [f"a pose has {value}, below the lower bound {lower_bound} of the others"]
    return []


def check_max_inliers(number: int) -> Checked:
    """How many pairs fit at most? No fit to a matching may bring more within the distance."""
    one = small(number, "range" if number % 4 == 1 else "")
    p = one.problem
    distance = (0.02, 0.1, 0.3, 1.0)[number // 3 % 4]
    keywords = {key: value for key, value in one.keywords.items() if key != "n_inliers"}
    found = dcreg.max_inliers(p.source, p.target, distance=distance, **keywords)
    rows, columns = found.assignment.T
    moved, faults = apply_pose(found.T_target_source, p.source[rows]), []
    if (np.linalg.norm(moved - p.target[columns], axis=1) > distance * (1 + 1e-12)).any():
        faults.append("a pair is farther than the distance")
    if p.pose_range is not None and not p.pose_range.contains(found.T_target_source):
        faults.append(f"the pose {found.T_target_source.tolist()} is outside the range")
    low, high = p.scale_range
    if not low * (1 - 1e-9) <= scale_of(found.T_target_source) <= high * (1 + 1e-9):
        faults.append("the scale of the pose is outside the range")
    if len(set(rows)) != found.at_least or len(set(columns)) != found.at_least:
        faults.append("the pairs are not one to one")
    if _within(p.source, p.target, found.T_target_source, 0.999 * distance) > found.at_least:
        faults.append("the pose has more pairs within the distance than are counted")
    fits = [*one.fits(), *one.with_n_inliers(min(2, p.n_inliers)).fits()]
    reached = max(_within(p.source, p.target, T, distance) for _, T in fits)
    if max(reached, found.at_least) > found.at_most:
        faults.append(f"at most {found.at_most}, but poses have {reached} and {found.at_least}")
    return ("exact" if found.is_exact else "interval"), faults


def _within(source: np.ndarray, target: np.ndarray, T: np.ndarray, distance: float) -> int:
    gaps = np.linalg.norm(apply_pose(T, source)[:, None] - target, axis=2)
    return int((largest_matching(gaps <= distance) >= 0).sum())


def check_range(number: int) -> Checked:
    """The best pose of a range: bounds on both sides of the optimum of all matchings."""
    return _check_register(small(number, "range"))


def check_sweep(number: int) -> Checked:
    """The best poses of a range for several numbers of pairs."""
    one = small(number, "range")
    p, keywords = one.problem, one.keywords
    most = keywords.pop("n_inliers")
    counts = range(max(1, most - 2), most + 1)
    found = dcreg.sweep(p.source, p.target, counts, **keywords)
    faults = [
        f"k={count}: {fault}"
        for count, result in zip(counts, found.results, strict=True)
        for fault in _faults(one.with_n_inliers(count), result)
    ]
    return found.status.value, faults


def _bounds(one: Small, found: dcreg.Result) -> list[str]:
    """Compare the bounds with the optimum of all matchings."""
    eps, faults = one.rounding(), []
    optimum = min(value for value, _ in one.fits())
    if found.lower_bound > optimum + eps:
        faults.append(f"lower bound {found.lower_bound} above the optimum {optimum}")
    if found.upper_bound < optimum - eps:
        faults.append(f"upper bound {found.upper_bound} below the optimum {optimum}")
    if found.status is Status.OPTIMAL and found.upper_bound > optimum + found.gap_tol + eps:
        faults.append(f"optimal with {found.upper_bound}, but the optimum is {optimum}")
    return faults


def check_similarity3d(number: int) -> Checked:
    """The best similarity in 3D: bounds on both sides of the optimum of all matchings."""
    return _check_register(small(number, "similarity3d"))


def check_weights(number: int) -> Checked:
    """The best pose of weighted points, by the weighted costs of all matchings."""
    return _check_register(small(number, "weights"))


def check_candidates(number: int) -> Checked:
    """The best pose over feasible pairs, by all feasible matchings."""
    return _check_register(small(number, "candidates"))


def check_attributes(number: int) -> Checked:
    """The best pose of points with attributes, some also with weights."""
    return _check_register(small(number, "attributes"))


def check_init(number: int) -> Checked:
    """The best pose does not depend on an initial guess, here the fit to some matching or a rough one."""
    one = small(number, ("", "candidates", "weights", "attributes")[number // 3 % 4])
    p, fits = one.problem, one.fits()
    rng = np.random.default_rng([12, number])
    T = fits[int(rng.integers(len(fits)))][1].copy()
    if number % 5 == 0:
        T[:-1, -1] += rng.standard_normal(p.dim)
    plain = dcreg.register(p.source, p.target, **one.keywords)
    found = dcreg.register(
        p.source, p.target, options=dcreg.SolveOptions(init=T), **one.keywords
    )  # fmt: skip
    faults = _faults(one, found)
    most = plain.objective + max(plain.gap_tol, found.gap_tol) + one.rounding()
    if plain.status is Status.OPTIMAL and found.objective > most:
        faults.append(
            f"objective {found.objective} with an initial guess, {plain.objective} without"
        )
    return found.status.value, faults


def _check_register(one: Small) -> Checked:
    """Compare a result with all matchings."""
    p = one.problem
    found = dcreg.register(p.source, p.target, **one.keywords)
    return found.status.value, _faults(one, found)


def _faults(one: Small, found: dcreg.Result) -> list[str]:
    """Compare bounds with all matchings, the objective with its pairs, and the pose with its limits."""
    p = one.problem
    rows, columns = found.assignment.T
    faults = _bounds(one, found)
    if not len(rows) == len(set(rows)) == len(set(columns)) == p.n_inliers:
        faults.append("the pairs are not one to one, or too few")
    if p.candidates is not None and not p.candidates[rows, columns].all():
        faults.append("a pair is not feasible")
    cost = one.cost(found.T_target_source, rows, columns)
    if abs(found.objective - cost) > one.rounding():
        faults.append(f"objective {found.objective}, but the pairs cost {cost}")
    low, high = p.scale_range
    if not low * (1 - 1e-9) <= scale_of(found.T_target_source) <= high * (1 + 1e-9):
        faults.append("the scale of the pose is outside the range")
    if p.pose_range is not None and not p.pose_range.contains(found.T_target_source):
        faults.append(f"the pose {found.T_target_source.tolist()} is outside the range")
    return faults


def check_covariance(number: int) -> Checked:
    """Is the covariance that of poses fitted to other draws of the same small noise?

    The variance of the residuals is an estimate by few pairs. It is replaced by the true one.
    """
    one = noisy(number)
    p, sigma = one.problem, one.sigma
    found = dcreg.register(
        p.source, p.target, n_inliers=p.n_inliers, model=p.model, scale_range=p.scale_range,
        time_limit=TIME_LIMIT,
    )  # fmt: skip
    if sorted(map(tuple, found.assignment.tolist())) != one.pairs:
        return "other pairs", []
    if found.covariance is None:
        return "none", ["no covariance, although the pairs determine the pose"]
    free = len(found.covariance) - (p.dim == 2 and p.scale_range == (1.0, 1.0))
    spare = p.source[: p.n_inliers].size - free
    stated = found.covariance * sigma**2 / (found.objective / spare)
    faults = []
    if np.abs(stated[free:]).max(initial=0.0) > 0.0:
        faults.append("the fixed scale has a variance")
    whitened = np.linalg.solve(np.linalg.cholesky(stated[:free, :free]), one.twists()[:, :free].T)
    ratios = np.linalg.eigvalsh(whitened @ whitened.T / whitened.shape[1])
    if ratios[0] < 1.0 - SPREAD or ratios[-1] > 1.0 + SPREAD:
        faults.append(f"in some direction, the variance is {ratios} times the stated one")
    return "compared", faults


CHECKS: dict[str, Callable[[int], Checked]] = {
    "max_rms": check_max_rms,
    "certify": check_certify,
    "alternatives": check_alternatives,
    "max_inliers": check_max_inliers,
    "range": check_range,
    "sweep": check_sweep,
    "similarity3d": check_similarity3d,
    "weights": check_weights,
    "candidates": check_candidates,
    "attributes": check_attributes,
    "init": check_init,
    "covariance": check_covariance,
}


def _apart(source: np.ndarray, T: np.ndarray, other: np.ndarray) -> float:
    gaps = apply_pose(T, source) - apply_pose(other, source)
    return float(np.sqrt((gaps**2).sum(axis=1).mean()))
