"""The estimate of the boxes that a proof takes, and searches that end because it is hopeless."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

import dcreg
from data.registry import dataset
from dcreg.driver import solve
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.problem import Frame, Problem
from dcreg.search import Boxes, Budget, Confined, LongestEdge, Start, Tolerance, branch_and_bound
from dcreg.search.branch_and_bound import Search
from dcreg.search.prospect import FEW_DESCENTS, MAX_TIME_RATIO, N_DESCENTS, Prospect, expected_boxes
from tests.unit.test_congruent import partial_overlap
from workflows.disturb import make_instance


@pytest.mark.parametrize(
    ("shape", "test", "level"),
    [("pony", "deformation", 0.03), ("pony", "separate_outliers", 0.2), ("saurian", "noise", 0.05)],
)
def test_the_estimate_is_near_the_number_of_boxes(shape, test, level):
    raw = make_instance(dataset("embedded"), shape, test, level, trial=0, n_points=25)
    k = len(raw.pairs)
    frame = Frame.of(Problem(raw.source, raw.target, k, "rigid3d"))
    space = Rigid3D.between(frame.source(raw.source), frame.target(raw.target), k)
    start, branching = space.start(Budget())[:2], LongestEdge(space.axis_weights)
    tolerance = Tolerance(rel=0.01)
    found = branch_and_bound(
        RigidBound(space), Budget(nodes=200_000), branching=branching, tolerance=tolerance, start=start
    )  # fmt: skip
    assert found.status == "optimal"
    estimate, n_tried = expected_boxes(
        RigidBound(space), branching, tolerance.cutoff(found.upper_bound)
    )
    assert found.n_nodes / 4 < estimate < 4 * found.n_nodes
    assert n_tried > N_DESCENTS
    few, n_few = expected_boxes(
        RigidBound(space), branching, tolerance.cutoff(found.upper_bound), is_late=lambda: True
    )
    assert found.n_nodes / 8 < few < 8 * found.n_nodes
    assert FEW_DESCENTS < n_few < n_tried / 4
    enough, n_enough = expected_boxes(
        RigidBound(space), branching, tolerance.cutoff(found.upper_bound),
        is_enough=lambda mean, _: mean > few / 8,
    )  # fmt: skip
    assert few / 8 < enough < few
    assert n_enough < n_few


@pytest.mark.parametrize(
    ("shape", "test"), [("pony", "mixed_outliers"), ("saurian", "separate_outliers")]
)
def test_the_estimate_from_open_boxes_is_closer(shape, test):
    raw = make_instance(dataset("embedded"), shape, test, 0.3, trial=0, n_points=40)
    frame = Frame.of(Problem(raw.source, raw.target, len(raw.pairs), "rigid3d"))
    space = Rigid3D.between(frame.source(raw.source), frame.target(raw.target), len(raw.pairs))
    bound, start = RigidBound(space, threads=2), Start(*space.start(Budget())[:2])
    search = Search(
        bound, Budget(), LongestEdge(space.axis_weights), Tolerance(rel=0.01), "search", None, start,
        None, Confined(Boxes.of(bound.roots), np.inf),
    )  # fmt: skip
    search.run(512)
    before, estimate = search.n_nodes, search.estimate()
    search.run()
    left = search.n_nodes - before
    assert left > 5000
    assert left / 1.5 < estimate < 1.5 * left


def test_the_estimate_of_a_continued_search_does_not_end_early(monkeypatch):
    """Before its first box after a checkpoint, the time per box is unknown."""
    given = []
    monkeypatch.setattr(Prospect, "of", lambda *arguments: given.append(arguments) or Prospect(1.0))
    points = np.random.default_rng(0).random((10, 3))
    space = Rigid3D.between(points - points.mean(axis=0), points[:8] - points.mean(axis=0), 8)
    bound, start = RigidBound(space), Start(*space.start(Budget())[:2])
    search = Search(
        bound, Budget(), LongestEdge(space.axis_weights), Tolerance(), "search", None, start,
        None, Confined(Boxes.of(bound.roots), np.inf),
    )  # fmt: skip
    search.patience_began -= 1.0
    search.estimate()
    assert given[0][-1] == 0.0


@pytest.mark.parametrize(
    ("limits", "patience_s", "n_nodes", "poor"),
    [
        ({"time_s": 100.0}, np.inf, 1_000, False),  # 99 s for the other 99,000 boxes
        ({"time_s": 100.0}, np.inf, 100, True),  # ten times as slow
        ({"time_s": 100.0}, None, 100, False),  # to be proved
        ({"time_s": None}, np.inf, 100, False),
        ({"time_s": None}, 2.0, 1_000, True),
        ({"time_s": 100.0}, 2.0, 60_000, False),
        # Counted searches must not depend on the clock.
        ({"time_s": 100.0, "nodes": 500}, np.inf, 100, False),
        ({"time_s": 100.0, "assignments": 500}, np.inf, 100, False),
    ],
)
def test_a_search_is_hopeless_if_it_needs_several_times_what_is_left(
    limits, patience_s, n_nodes, poor
):
    assert MAX_TIME_RATIO == 1.5
    with Budget(**limits) as budget:
        prospect = Prospect(n_nodes=100_000.0)
        assert prospect.is_poor(n_nodes, 1.0, budget.with_patience(patience_s)) == poor


def test_local_searches_and_estimates_say_nothing_about_the_time_of_boxes():
    """Otherwise a few first boxes between many local searches would let a short proof seem hopeless."""
    with Budget(10.0) as budget:
        waiting = budget.with_patience(5.0)
        prospect = Prospect(n_nodes=3000.0)
        assert prospect.is_poor(100, 1.0, waiting)
        assert not prospect.is_poor(100, 1.0, waiting, not_bounding_s=0.9)
        assert prospect.expected_s(100, 1.0, waiting, not_bounding_s=0.9) == pytest.approx(2.9)


def test_boxes_of_the_estimate_tell_how_long_boxes_take():
    """The first boxes of a search take longer than later ones."""
    with Budget(10.0) as budget:
        waiting = budget.with_patience(5.0)
        assert Prospect(3000.0).is_poor(10, 0.5, waiting)
        assert not Prospect(3000.0, 490, 0.5).is_poor(10, 0.5, waiting)


@pytest.mark.parametrize(
    ("n_nodes", "spent_s", "near"),
    [
        (720, 4.9, True),  # 1.9 s more: less than 2 s after the end of the patience
        (600, 4.9, False),
        (900, 6.5, False),  # 0.72 s
        (950, 6.5, True),
        (1000, 6.5, False),  # the estimate was too low, so nothing is known
    ],
)
def test_a_proof_is_awaited_for_a_short_time_after_the_patience(n_nodes, spent_s, near):
    with Budget(100.0) as budget:
        waiting, prospect = budget.with_patience(5.0), Prospect(1000.0)
        assert prospect.is_near(n_nodes, spent_s, waiting) == near
        assert not prospect.is_near(n_nodes, spent_s, budget)
        assert not Prospect(1000.0).is_poor(720, 4.9, waiting)
        assert Prospect(1e5).is_poor(720, 4.9, waiting)


def test_a_hopeless_search_ends_with_its_reason_unless_a_proof_is_requested():
    source, target, _ = partial_overlap(0, n_common=40, n_clutter=120)
    settings = {"n_inliers": 40, "model": "rigid3d"}
    found = dcreg.register(source, target, **settings, time_limit=12.0)
    assert (found.status, found.reason) == ("converged", "proof not expected soon")
    assert "no proof is expected soon" in found.warnings[0]
    assert str(found).splitlines()[0].endswith("prove=True (--prove) searches longer")
    assert found.to_dict()["reason"] == found.reason
    proved = dcreg.register(
        source, target, **settings, time_limit=3.0, options=dcreg.SolveOptions(prove=True)
    )
    assert (proved.status, proved.reason) == ("time_limit", "")
    assert proved.n_nodes > 0


def test_the_estimate_is_reported_and_is_no_work_of_the_search(monkeypatch):
    """The counters of a search that ends with a proof must not depend on the clock."""
    raw = make_instance(dataset("embedded"), "pony", "separate_outliers", 0.2, trial=0, n_points=25)
    settings = {"n_inliers": len(raw.pairs), "model": "rigid3d", "time_limit": 1e6}
    for prove in (False, True):
        for name in ("ESTIMATED_AFTER_S", "ESTIMATED_FOR_LISTENER_AFTER_S"):
            monkeypatch.setattr(sys.modules["dcreg.search.branch_and_bound"], name, 0.0)
        monkeypatch.setattr(solve, "PATIENCE_S", np.inf)
        options = dcreg.SolveOptions(prove=prove, listener=lambda event: False)
        asked = dcreg.register(raw.source, raw.target, **settings, options=options)
        assert any(event.expected_s is not None for event in asked.trace)
        assert asked.trace.events[-1].expected_s is None
        monkeypatch.undo()
        never = dcreg.register(
            raw.source, raw.target, **settings, options=dcreg.SolveOptions(prove=True)
        )
        assert asked.status == never.status == "optimal"
        assert (asked.n_nodes, asked.n_assignments) == (never.n_nodes, never.n_assignments)


@pytest.mark.parametrize(
    ("time_s", "n_nodes", "expected"),
    [(100.0, 10_000, 9.0), (5.0, 10_000, np.inf), (None, 10_000, 9.0), (100.0, 100_000, None)],
)
def test_the_time_to_the_proof_is_that_of_the_boxes_left(time_s, n_nodes, expected):
    with Budget(time_s) as budget:
        assert Prospect(n_nodes=100_000.0).expected_s(n_nodes, 1.0, budget) == expected


@pytest.mark.parametrize(
    ("n_nodes", "spent_s", "fast"),
    [
        (500, 0.2, True),  # 2,048 boxes take 0.8 s of 5 s
        (500, 0.3, False),  # ... 1.2 s
        (3_000, 0.3, False),
    ],
)
def test_fast_boxes_before_a_cover_ask_for_no_estimate(n_nodes, spent_s, fast):
    search = SimpleNamespace(
        budget=SimpleNamespace(patience_s=5.0), n_nodes=n_nodes, n_before_estimate=2_048
    )
    assert Search._is_before_estimate(search, spent_s) == fast


@pytest.mark.parametrize(("threads", "patience_s"), [(1, 5.0), (2, 2.5), (64, 1.0)])
def test_threads_share_the_patience(rng, threads, patience_s):
    problem = Problem(*rng.standard_normal((2, 12, 3)), 10, "rigid3d")
    options = dcreg.SolveOptions(threads=threads)
    setup = solve.Setup.of([problem], solve.Limits(), options)
    assert setup.normalised(0, Budget()).patience_s == patience_s


@pytest.mark.parametrize(("processors", "threads"), [(1, 1), (2, 2), (64, 8)])
def test_a_search_uses_all_processors_up_to_eight(monkeypatch, processors, threads):
    monkeypatch.setattr("dcreg.driver.options.usable_processors", lambda: processors)
    assert dcreg.SolveOptions().n_threads == threads
    assert dcreg.SolveOptions(threads=3).n_threads == 3
