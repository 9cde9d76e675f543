"""The parts of the check of a certificate: imports, objectives, bounds, assignments, partitions."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcreg.certificate import CertificateError, proof, write
from dcreg.certificate.assignment import cheapest_pairs, duals_of
from dcreg.certificate.objectives import OBJECTIVES
from dcreg.certificate.proof import Proof, check_partition
from dcreg.certificate.verification import verify
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Boxes, LongestEdge
from tests.certificates import DIM, certify, clouds, made_case, rigid_case
from tests.problems import models_with_boxes


@pytest.fixture(scope="module", params=DIM)
def case(request):
    return made_case(request.param)


WITHOUT_THE_SEARCH = """
import sys, types
package = types.ModuleType("dcreg")
package.__path__ = ["dcreg"]  # its __init__, which imports everything, is not run
sys.modules["dcreg"] = package
for name in ("search", "families", "assignment", "driver", "problem", "jit"):
    sys.modules[f"dcreg.{name}"] = None  # importing it raises
import numpy as np
from dcreg.certificate.verification import verify
report = verify(sys.argv[1], np.load(sys.argv[2]), np.load(sys.argv[3]))
print(report.accepted, report.reason)
assert not [name for name in sys.modules if name.startswith("numba")]
"""


@pytest.mark.parametrize("model", [*DIM, "rigid3d"])
def test_verification_runs_where_the_search_cannot_be_imported(tmp_path, model):
    certificate, source, target = made_case(model) if model in DIM else rigid_case()
    names = [tmp_path / name for name in ("certificate.npz", "source.npy", "target.npy")]
    write(names[0], certificate)
    np.save(names[1], source)
    np.save(names[2], target)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_THE_SEARCH, *map(str, names)],
        cwd=Path(__file__).parents[2], capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.split() == ["True"], done.stdout + done.stderr


def test_radius_start_box_contains_the_region_of_a_single_far_pair():
    """`region` projects the cloud on directions, and must not exceed what follows from the radii."""
    source = np.array([[1.0, 0.0], [0.1, 0.0], [0.0, -0.1]])
    clouds = source, -source, 1, (0.5, 1.5)
    lower, upper = OBJECTIVES["similarity2d"](*clouds).region()
    (start,) = Similarity2D(*clouds, stationary_box=False).roots()
    assert (start.lower <= lower + 1e-12).all()
    assert (start.upper >= upper - 1e-12).all()


@settings(max_examples=150)
@given(models_with_boxes(max_points=7), st.integers(0, 2**32 - 1))
def test_plain_bounds_hold_and_objectives_agree(case, seed):
    space, box = case
    name = "similarity2d" if box.dim == 4 else "translation3d"
    objective = OBJECTIVES[name](space.source, space.target, space.n_inliers, (0.5, 1.5))
    thetas = np.vstack([box.sample(np.random.default_rng(seed), 20), box.vertices(), box.centre])
    values = np.array([objective.value(theta) for theta in thetas])
    np.testing.assert_allclose(values, [space.objective(t)[0] for t in thetas], atol=1e-9)
    assert (objective.lower_bounds(thetas) <= values + 1e-9).all()
    for bound in (
        objective.nearest_bound,
        objective.interval_bound,
        Proof(objective, 0.0, 1).tangent_bound,
    ):
        for needed in (np.inf, 1.5 * values.min(), 0.5 * values.min()):
            found = bound(box.lower[None], box.upper[None], needed)[0]
            assert found <= values.min() + 1e-9
    (start,) = space.roots()
    region_lower, region_upper = objective.region()
    assert (start.lower <= region_lower + 1e-9).all()
    assert (start.upper >= region_upper - 1e-9).all()


def test_a_proof_over_norms_solves_no_assignments_and_divides_few_leaves():
    """Some norms remain unmatched; the lower bound is above 0, so that every leaf needs a proof."""
    source, target = clouds("translation3d", n=20, extra=3, seed=3)
    certificate = certify(source, target, 20, "translation3d", bound="tight", tau=0.0125)
    assert certificate.status == "optimal"
    assert certificate.lower_bound > 0
    report = verify(certificate, source, target)
    assert report.accepted, report.reason
    assert report.n_leaves > 1000
    assert report.n_boxes < 1.02 * report.n_leaves
    assert report.n_assignments == 1  # of the stated optimum


@pytest.mark.parametrize("n", [5, 30, 80])
def test_duals_attain_the_cost_of_the_assignment(n):
    """Also if the shortest paths are long: pairs one after the other along a line."""
    places = np.arange(n, dtype=float)
    random = np.random.default_rng(n).random((n, n))
    for cost in (np.abs(places[:, None] - places - 1.0) ** 1.5, random):
        wide, columns = cheapest_pairs(cost, n - 1)
        duals = duals_of(wide, columns)
        bound = (wide + duals).min(axis=1).sum() - duals[columns].sum()
        assert bound == pytest.approx(wide[np.arange(n), columns].sum(), abs=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.005, 0.2), st.floats(1.01, 3.0))
def test_curvature_makes_relevant_matchings_concave(seed, size, share):
    """A matching whose sum is below `needed` somewhere in the box, less the quadratic, is concave."""
    generator = np.random.default_rng(seed)
    source, target = clouds("translation3d", n=10, extra=2, seed=seed)
    objective = OBJECTIVES["translation3d"](source, target, 10, (1.0, 1.0))
    centre = 0.3 * generator.standard_normal(3)
    lower = centre - size * generator.random(3)
    upper = centre + size * generator.random(3)
    within = lower + generator.random((3, 3)) * (upper - lower)
    wide, columns = cheapest_pairs(objective.costs(within[0]), 10)
    rows = np.flatnonzero(columns < len(target))
    value = wide[np.arange(len(wide)), columns].sum()
    (matrix,) = objective.curvature(lower[None], upper[None], share * value)

    def rest(theta):
        residuals = np.linalg.norm(source[rows] + theta, axis=1) - objective.norms[columns[rows]]
        return (residuals**2).sum() - theta @ matrix @ theta

    _, a, b = within
    assert rest(0.5 * (a + b)) >= 0.5 * (rest(a) + rest(b)) - 1e-12


def test_curvature_is_less_than_that_of_all_pairs_in_small_boxes():
    source, target = clouds("translation3d", n=30, extra=2)
    objective = OBJECTIVES["translation3d"](source, target, 30, (1.0, 1.0))
    theta = np.array([[0.02, -0.03, 0.05]])
    (near_any,) = objective.curvature(theta - 0.01, theta + 0.01, np.inf)
    np.testing.assert_array_equal(near_any, 30 * np.eye(3))
    (near_optimum,) = objective.curvature(theta - 0.01, theta + 0.01, 0.1)
    assert np.linalg.eigvalsh(near_optimum).max() < 30


@st.composite
def partitions(draw):
    """Leaves of a random bisection tree; one axis may be flat."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lower, upper = -generator.random((1, 3)), generator.random((1, 3))
    if draw(st.booleans()):
        lower[0, 1] = upper[0, 1] = 0.0
    start = lower[0], upper[0]
    for _ in range(draw(st.integers(1, 40))):
        pick = generator.integers(len(lower))
        halves = LongestEdge(generator.random(3) + 0.1)(Boxes(lower[[pick]], upper[[pick]]))
        lower = np.vstack([np.delete(lower, pick, axis=0), halves.lower])
        upper = np.vstack([np.delete(upper, pick, axis=0), halves.upper])
    order = generator.permutation(len(lower))
    return start, lower[order], upper[order], generator


def test_a_partition_of_many_leaves_needs_few_cuts(monkeypatch):
    """A cut of every two leaves takes most of the time of a check."""
    steps = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cuts, cut = [], proof._cut
    monkeypatch.setattr(proof, "_cut", lambda *given: cuts.append(1) or cut(*given))
    check_partition(np.zeros(3), np.full(3, 12.0), steps, steps + 1.0)
    assert len(cuts) < len(steps) / 10
    with pytest.raises(CertificateError, match="gap"):
        check_partition(np.zeros(3), np.full(3, 12.0), steps[1:], steps[1:] + 1.0)


@given(partitions(), st.sampled_from([0, 5, proof.FEW_LEAVES]))
def test_partitions_are_accepted_and_broken_ones_refused(partition, few):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "FEW_LEAVES", few)
        check_whole_and_broken(*partition)


def check_whole_and_broken(start, lower, upper, generator):
    check_partition(*start, lower, upper)
    check_partition(*start, lower - 1e-15, upper)  # rounding
    leaf = generator.integers(len(lower))
    if len(lower) > 1:
        with pytest.raises(CertificateError, match="gap"):
            check_partition(*start, np.delete(lower, leaf, axis=0), np.delete(upper, leaf, axis=0))
    with pytest.raises(CertificateError, match="overlap"):
        check_partition(*start, np.vstack([lower, lower[leaf]]), np.vstack([upper, upper[leaf]]))
    axis = np.argmax(upper[leaf] - lower[leaf])
    for step in (0.3, -0.3):
        moved = upper.copy()
        moved[leaf, axis] += step * (upper - lower)[leaf, axis]
        with pytest.raises(CertificateError, match="leaves: "):
            check_partition(*start, lower, moved)
