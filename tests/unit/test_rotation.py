"""The rotation search: its optimum, its limits, and improper rotations, which it never returns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcreg.families.rotation3d.kernels.geometry import best_rotation
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.status import Status
from tests.oracles.matchings import cheapest_fit
from tests.problems import KINDS, cloud
from tests.searches import search_rotation


def kabsch(source, target):
    """Proper rotation by the singular value decomposition, without centring."""
    u, _, vt = np.linalg.svd(target.T @ source)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def exhaustive_optimum(source, target, k):
    """Every matching of k pairs, each with its own best rotation."""
    return cheapest_fit(source, target, k, lambda x, y: x @ kabsch(x, y).T)


def planted(rng, n=60, noise=0.03):
    source = rng.standard_normal((n, 3)) * [1.0, 0.7, 0.4]
    rotation = Rotation.random(random_state=7).as_matrix()
    order = rng.permutation(n)
    target = (source @ rotation.T + noise * rng.standard_normal((n, 3)))[order]
    return source, target, rotation, order


def check_result(result, source, target):
    """Check what holds for every status."""
    R = result.rotation
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    rows, columns = result.assignment.T
    assert len(set(rows)) == len(rows) == len(set(columns))
    residual = ((source[rows] @ R.T - target[columns]) ** 2).sum()
    assert residual == pytest.approx(result.upper_bound, abs=1e-9)
    assert 0.0 <= result.lower_bound <= result.upper_bound


@pytest.mark.parametrize("kind", [*KINDS, "with origin", "mirrored"])
@pytest.mark.parametrize(("n", "m", "k"), [(4, 4, 4), (4, 5, 2), (5, 4, 3), (4, 4, 1), (1, 3, 1)])
def test_search_finds_the_exhaustive_optimum(kind, n, m, k, rng):
    source, target = cloud(rng, n, 3, kind), cloud(rng, m, 3, kind)
    if kind == "with origin":
        source[0] = target[-1] = 0.0
    if kind == "mirrored":
        both = min(n, m)
        target[:both] = source[:both] * [1.0, 1.0, -1.0]
    gap_tol = 1e-2 * k
    result = search_rotation(source, target, k, gap_tol=gap_tol)
    best = exhaustive_optimum(source, target, k)
    check_result(result, source, target)
    assert result.status is Status.OPTIMAL
    assert len(result.assignment) == k
    assert result.lower_bound <= best + 1e-9
    assert best - 1e-9 <= result.upper_bound <= best + gap_tol + 1e-9


@pytest.mark.parametrize(("k", "n_outliers"), [(60, 0), (45, 0), (60, 15)])
def test_planted_rotation_is_recovered(k, n_outliers, rng):
    source, target, rotation, order = planted(rng)
    source = np.concatenate([source, rng.uniform(-2, 2, (n_outliers, 3))])
    target = np.concatenate([target, rng.uniform(-2, 2, (n_outliers, 3))])
    result = search_rotation(source, target, k, gap_tol=k * 0.03**2, nodes=50_000)
    check_result(result, source, target)
    assert result.status is Status.OPTIMAL
    assert result.upper_bound - result.lower_bound <= k * 0.03**2
    assert Rotation.from_matrix(result.rotation @ rotation.T).magnitude() < 0.05
    rows, columns = result.assignment.T
    planted_pairs = columns < 60
    assert (order[columns[planted_pairs]] == rows[planted_pairs]).mean() > 0.9


def test_nothing_is_centred(rng):
    """The search rotates about the origin: a shifted copy has no rotation with zero residual."""
    source = rng.standard_normal((5, 3))
    target = source + np.array([0.5, 0.0, 0.0])
    result = search_rotation(source, target, 5, gap_tol=1e-3)
    assert result.lower_bound > 0.0
    assert result.upper_bound == pytest.approx(exhaustive_optimum(source, target, 5), abs=1e-3)


def test_fit_agrees_with_the_singular_value_decomposition(rng):
    for mirror in (1.0, -1.0):
        source, target = rng.standard_normal((2, 8, 3)) * [1.0, 1.0, mirror]
        theta = best_rotation(source.T, target.T)
        np.testing.assert_allclose(Rotation3D.matrix(theta), kabsch(source, target), atol=1e-9)


def test_refine_stays_in_a_root_and_never_rises(rng):
    source, target, _, _ = planted(rng, n=20, noise=0.2)
    model = Rotation3D(source, target, 15)
    for theta in rng.standard_normal((20, 4)):
        before, _ = model.objective(theta)
        after, value, spent = model.refine(theta)
        assert value <= before
        assert model.objective(after)[0] == pytest.approx(value)
        assert spent >= 2
        assert any((r.lower <= after).all() and (after <= r.upper).all() for r in model.roots())


def test_a_tighter_gap_costs_a_bounded_factor(rng):
    """The bounds are of second order: a 100 times smaller tolerance needs few more boxes."""
    source, target, _, _ = planted(rng, n=40, noise=0.08)
    loose = search_rotation(source, target, 40, gap_tol=40 * 1e-3, nodes=100_000)
    tight = search_rotation(source, target, 40, gap_tol=40 * 1e-5, nodes=100_000)
    assert loose.status is tight.status is Status.OPTIMAL
    assert tight.n_nodes < 5 * loose.n_nodes


def test_limits_leave_valid_bounds(rng):
    source, target = rng.standard_normal((2, 25, 3))
    certified = search_rotation(source, target, 10, gap_tol=0.1)
    by_nodes = search_rotation(source, target, 10, gap_tol=1e-9, nodes=200)
    by_time = search_rotation(source, target, 10, gap_tol=1e-9, time_s=0.0)
    assert by_nodes.status is Status.NODE_LIMIT
    assert by_time.status is Status.TIME_LIMIT
    for result in (by_nodes, by_time):
        check_result(result, source, target)
        assert result.lower_bound <= certified.upper_bound
        assert result.upper_bound >= certified.lower_bound


def test_listener_sees_the_search_and_may_stop_it(rng):
    source, target = rng.standard_normal((2, 25, 3))
    seen = []

    def listener(event):
        seen.append(event)
        return len(seen) == 3

    result = search_rotation(source, target, 10, gap_tol=1e-9, listener=listener)
    assert result.status is Status.STOPPED
    assert {event.stage for event in seen} == {"start", "rotation"}
    assert result.events[-1].kind == "end"
    lower = [event.lower_bound for event in seen]
    upper = [event.upper_bound for event in seen]
    assert lower == sorted(lower)
    assert upper == sorted(upper, reverse=True)
