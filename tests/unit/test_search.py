"""Branch and bound on a function without geometry."""

from types import SimpleNamespace

import numpy as np
import pytest

from dcreg.search import (
    Box,
    Boxes,
    Budget,
    Confined,
    Evaluation,
    LongestEdge,
    Tolerance,
    branch_and_bound,
    space_search,
)
from dcreg.search.branch_and_bound import REFINING_PATIENCE, Search, Start
from dcreg.search.prospect import N_DESCENTS, Prospect
from dcreg.status import Status

ROOT = [Box(-np.ones(2), np.ones(2))]


class Ripples:
    """f(t) = |t - c|^2 + 0.3 (1 - cos 8 t_1), bounded by f(centre) - L * radius."""

    centre = np.array([0.3, -0.2])
    lipschitz = 8.0

    def __init__(self, round_size=16):
        self.n_assignments = 0
        self.round_size = round_size
        self.roots = ROOT

    def fresh(self):
        return Ripples(self.round_size)

    def value(self, thetas):
        return ((thetas - self.centre) ** 2).sum(axis=1) + 0.3 * (1 - np.cos(8 * thetas[:, 0]))

    def evaluate(self, boxes, cutoff):
        values = self.value(boxes.centres)
        self.n_assignments += len(values)
        radius = np.linalg.norm(0.5 * (boxes.upper - boxes.lower), axis=1)
        return Evaluation(values - self.lipschitz * radius, boxes.centres, values)


def solve(round_size=16, keep_leaves=False, **limits):
    return branch_and_bound(
        Ripples(round_size), Budget(**limits), tolerance=Tolerance(abs=1e-2),
        branching=LongestEdge(np.ones(2)),
        keep_leaves=keep_leaves,
    )  # fmt: skip


def dense_minimum():
    axis = np.linspace(-1, 1, 801)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return Ripples().value(grid).min()


def test_bounds_enclose_the_minimum_and_close():
    found = solve()
    assert found.status is Status.OPTIMAL
    assert found.upper_bound - found.lower_bound <= 1e-2
    assert found.lower_bound <= dense_minimum() <= found.upper_bound + 1e-4
    assert Ripples().value(found.theta[None])[0] == found.upper_bound


class Remembering(Ripples):
    """Warm starts are lower vertices, so that a box can tell whether its own comes from its parent."""

    n_warm = 0

    def evaluate(self, boxes, cutoff):
        found = super().evaluate(boxes, cutoff)
        lower, upper, warm_start = boxes.lower, boxes.upper, boxes.warm_start
        if warm_start is not None:
            self.n_warm += len(warm_start)
            assert warm_start.shape == (len(lower), 2)
            assert (warm_start[:, 0] <= lower[:, 0]).all()
            assert (warm_start[:, 1] <= lower[:, 1]).all()
            # a parent is at most twice as wide along each axis
            assert (lower - warm_start <= upper - lower + 1e-12).all()
        found.warm_start = lower.copy()
        return found


def test_children_inherit_the_warm_start_of_their_parent():
    bound = Remembering()
    found = branch_and_bound(
        bound, Budget(), tolerance=Tolerance(abs=1e-2), branching=LongestEdge(np.ones(2))
    )
    assert bound.n_warm == found.n_nodes - len(ROOT) > 0
    assert found.upper_bound == solve().upper_bound
    assert found.n_nodes == solve().n_nodes


@pytest.mark.parametrize("round_size", [1, 7, 64])
def test_any_round_size_reaches_the_same_optimum(round_size):
    assert solve(round_size=round_size).upper_bound == pytest.approx(dense_minimum(), abs=1.1e-2)


def test_history_is_monotone_and_has_an_end():
    events = solve(round_size=1).events
    lower = [event.lower_bound for event in events]
    upper = [event.upper_bound for event in events]
    assert lower == sorted(lower)
    assert upper == sorted(upper, reverse=True)
    assert [event.kind for event in events].count("end") == 1
    assert events[-1].kind == "end"
    assert events[-1].status == "optimal"


@pytest.mark.parametrize(
    ("limits", "status"),
    [
        ({"nodes": 50}, Status.NODE_LIMIT),
        ({"time_s": 1e-9}, Status.TIME_LIMIT),
        ({"memory_mb": 0.003}, Status.MEMORY_LIMIT),
    ],
)
def test_limits_keep_valid_bounds(limits, status):
    found = solve(**limits)
    assert found.status is status
    assert found.lower_bound <= dense_minimum() <= found.upper_bound
    assert found.events[-1].status == status.value


def test_listener_stops_the_search_and_sees_its_end():
    seen = []

    def listener(event):
        seen.append(event)
        return event.n_nodes > 20

    found = solve(listener=listener)
    assert found.status is Status.STOPPED
    assert seen[-1].kind == "end"
    assert seen[-1].status == "stopped"
    assert found.lower_bound <= dense_minimum() <= found.upper_bound


@pytest.mark.parametrize("limits", [{}, {"nodes": 50}])
def test_leaves_cover_the_root_exactly(limits):
    found = solve(keep_leaves=True, **limits)
    leaves = found.leaves.boxes
    assert (leaves.upper - leaves.lower).prod(axis=1).sum() == pytest.approx(4.0, abs=1e-12)
    assert found.lower_bound == min(leaves.bounds.min(), found.upper_bound)
    assert found.leaves.is_open.any() == bool(limits)
    if not limits:
        assert (leaves.bounds >= found.upper_bound - 1e-2).all()
    points = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    inside = (points[:, None] >= leaves.lower) & (points[:, None] <= leaves.upper)
    assert (inside.all(axis=2).sum(axis=1) == 1).all()


def test_root_without_admissible_parameter_is_not_searched():
    class Nothing(Ripples):
        def value(self, thetas):
            return np.full(len(thetas), np.inf)

    found = branch_and_bound(
        Nothing(), Budget(), branching=LongestEdge(np.ones(2)), tolerance=Tolerance(abs=0.1),
        start=(np.zeros(2), 1.0),
    )  # fmt: skip
    assert found.upper_bound == 1.0
    assert found.n_nodes == 1


def test_children_cover_their_parent_along_the_weighted_longest_edge():
    box = Box(np.zeros(2), np.array([1.0, 0.9]))
    halves = LongestEdge(np.array([1.0, 2.0]))(Boxes.of([box]))
    np.testing.assert_allclose(halves.lower, [[0, 0], [0, 0.45]])
    np.testing.assert_allclose(halves.upper, [[1, 0.45], [1, 0.9]])


def test_box_refuses_crossed_limits():
    with pytest.raises(ValueError, match="not a box"):
        Box(np.ones(2), np.zeros(2))


def _overlap(lower, upper, of_lower, of_upper):
    """Whether two boxes share more than a face; on an axis without width, whether they touch."""
    low, high = np.maximum(lower, of_lower), np.minimum(upper, of_upper)
    is_flat = (lower == upper) | (of_lower == of_upper)
    return bool(np.where(is_flat, low <= high, low < high).all())


@pytest.mark.parametrize(("count", "span"), [(0, 6), (7, 6), (9, 6), (200, 25)])
def test_boxes_meet_those_with_which_they_share_more_than_a_face(count, span):
    """Up to `FAN` boxes need no hierarchy."""
    rng = np.random.default_rng(4)
    for _ in range(40):
        lower, of_lower = rng.integers(0, span, (20, 3)), rng.integers(0, span, (count, 3))
        boxes = Boxes(lower * 1.0, lower + rng.integers(0, 3, lower.shape) * 1.0)
        others = Boxes(of_lower * 1.0, of_lower + rng.integers(0, 3, of_lower.shape) * 1.0)
        meeting = Confined(others, 1.0).meeting(boxes)
        expected = [
            any(_overlap(*box, *other) for other in zip(others.lower, others.upper, strict=True))
            for box in zip(boxes.lower, boxes.upper, strict=True)
        ]
        np.testing.assert_array_equal(meeting.lower, boxes.lower[expected])
        np.testing.assert_array_equal(meeting.upper, boxes.upper[expected])


def paused_search(budget=None):
    search = Search(
        Ripples(), budget or Budget(), LongestEdge(np.ones(2)), Tolerance(abs=1e-2), "search", None,
        Start(np.zeros(2), 0.5), None, Confined(Boxes.of(ROOT), np.inf),
    )  # fmt: skip
    search.run(64)
    return search


def around(centre, outside):
    half = np.array([0.25, 0.25])
    return Confined(Boxes((centre - half)[None], (centre + half)[None]), outside)


def test_a_narrowed_search_bounds_only_boxes_that_meet_the_confined_ones():
    search = paused_search()
    search.narrow(around(Ripples.centre, 0.4))
    search.run()
    found = search.outcome()
    assert found.status is Status.OPTIMAL
    assert found.lower_bound <= dense_minimum() <= found.upper_bound + 1e-4
    assert found.n_nodes < solve().n_nodes


def test_what_a_narrowed_search_leaves_out_has_the_bound_that_was_proved_for_it():
    """Without boxes that are left, only this bound remains, here below all others."""
    search = paused_search()
    search.narrow(Confined(Boxes(np.empty((0, 2)), np.empty((0, 2))), 1e-4))
    assert len(search.nodes) == len(search.boxes) == 0
    assert search.lower_bound == 1e-4


def test_a_narrowed_search_has_its_whole_patience_and_no_more(set_clock):
    search = paused_search(Budget(time_s=100.0).with_patience(5.0))
    set_clock.now += 3.0  # of a stage that confined it
    search.narrow(around(Ripples.centre, 0.4))
    set_clock.now += 4.9
    assert not search._has_no_prospect()
    set_clock.now += 0.2
    assert search._has_no_prospect()


def test_local_searches_and_the_estimate_are_set_aside(set_clock, monkeypatch):
    """They say nothing about the time that boxes take."""
    search, asked = paused_search(Budget(time_s=1000.0).with_patience(900.0)), []

    def refine(theta):
        set_clock.now += 2.0
        return theta, np.inf, 1

    def estimate(*_):
        set_clock.now += 3.0
        return Prospect(1e6)

    monkeypatch.setattr(Prospect, "of", estimate)
    monkeypatch.setattr(Prospect, "is_poor", lambda *given: asked.append(given[1:]))
    search.refine, search.worth_refining = refine, np.inf
    search.run(search.n_nodes + 1)
    assert [not_bounding_s for *_, not_bounding_s in asked] == [2.0, 5.0]
    n_nodes, spent_s, _, not_bounding_s = asked[-1]
    assert n_nodes == search.n_nodes
    assert not_bounding_s == search.not_bounding_s == 5.0
    assert spent_s == search.budget.elapsed() - search.patience_began >= not_bounding_s


def test_a_local_search_that_finds_nothing_does_not_make_the_next_one_likelier():
    """In a search of 400 points in 3D, they took a quarter of the time."""
    search, begun = paused_search(), []

    def refine(theta):
        begun.append(float(Ripples().value(theta[None])[0]))
        return theta, np.inf, 0

    search.refine, search.worth_at_most = refine, lambda value: 0.5 * value
    search.worth_refining = np.inf
    search.run(search.n_nodes + 1)
    assert len(begun) == 1
    assert search.worth_refining == pytest.approx(0.5 * search.upper_bound * REFINING_PATIENCE)
    assert search.worth_refining < begun[0]


def test_the_space_tells_from_where_local_searches_pay(monkeypatch):
    space = SimpleNamespace(
        axis_weights=np.ones(2), is_confirmed=True, refine=None, start=None, ends=(),
        worth_refining=lambda value: 2.0 * value,
    )  # fmt: skip
    begun, run = [], Search.run
    monkeypatch.setattr(Search, "run", lambda self, *to: (begun.append(self), run(self, *to)))
    space_search.minimise(
        space, Ripples(), Budget(), tolerance=Tolerance(abs=1e-2), start=(np.zeros(2), 0.5)
    )
    assert begun[0].worth_at_most(0.5) == 1.0


class SlowRipples(Ripples):
    """Takes a second for each call."""

    def __init__(self, clock):
        super().__init__()
        self.clock = clock

    def evaluate(self, boxes, cutoff):
        self.clock.now += 1.0
        return super().evaluate(boxes, cutoff)


@pytest.mark.parametrize(("patience_s", "is_short"), [(5.0, True), (5000.0, False)])
def test_an_estimate_that_takes_long_is_short(set_clock, patience_s, is_short):
    """Here its first part takes several seconds."""
    budget, bound = Budget(time_s=1e6).with_patience(patience_s), SlowRipples(set_clock)
    found = Prospect.of(
        bound, LongestEdge(np.ones(2)), 0.1, Boxes.of(ROOT), lambda boxes: boxes, budget, 0.0
    )
    assert 0 < found.n_nodes < np.inf
    assert (found.n_tried < 2 * N_DESCENTS) == is_short
    assert found.tried_s == set_clock.now - budget._began


def test_slow_calls_of_a_new_bound_end_no_estimate(set_clock):
    """They made it far too low: the search then went on instead of ending."""

    def n_tried(box_s):
        budget = Budget(time_s=1e6).with_patience(5.0)
        return Prospect.of(
            SlowRipples(set_clock), LongestEdge(np.ones(2)), 0.1, Boxes.of(ROOT),
            lambda boxes: boxes, budget, 0.0, box_s,
        ).n_tried  # fmt: skip

    assert n_tried(50.0) < n_tried(1e-6) == n_tried(0.0)


class SlowCover:
    """Takes three seconds and confines the search to a part of the roots."""

    stage, threads, applies, shares, box_s = "slow", 1, True, (1.0,), np.inf

    def __init__(self, clock):
        self.clock = clock

    def confine(self, cutoff, budget, allowed_s):
        self.clock.now += 3.0
        return around(Ripples.centre, cutoff)


def test_the_time_of_a_cover_is_counted_once(set_clock, monkeypatch):
    found, waited, paused = solve(), [], paused_search(Budget(time_s=100.0).with_patience(5.0))
    monkeypatch.setattr(Search, "run", lambda self, pause: waited.append(self.patience_began))
    monkeypatch.setattr(Search, "outcome", lambda self: found)
    space_search._with_cover(space_search.Course(None, paused), SlowCover(set_clock), 5.0)
    assert waited == [paused.budget.elapsed()]


def test_a_cover_that_gives_up_is_shown_and_its_time_is_kept(set_clock, monkeypatch):
    class GivesUp(SlowCover):
        shares = (1.0, 0.5)

        def confine(self, cutoff, budget, allowed_s):
            self.clock.now += 3.0

    events = []
    paused = paused_search(Budget(time_s=100.0, listener=events.append).with_patience(5.0))
    ended, n_known = solve(), len(events)
    monkeypatch.setattr(Search, "run", lambda self, pause: None)
    monkeypatch.setattr(Search, "outcome", lambda self: ended)
    found = space_search._with_cover(space_search.Course(None, paused), GivesUp(set_clock), 5.0)
    assert found.abandoned_s == {"slow": 6.0}
    assert not found.confined
    shown = [event for event in events[n_known:] if event.stage == "slow"]
    assert [event.kind for event in shown] == ["heartbeat"] * 2
    assert {event.upper_bound for event in shown} == {paused.upper_bound}


class Asked(SlowCover):
    """Proves nothing, and keeps the seconds that it was given."""

    def __init__(self, box_s, shares=(1.0, 0.5)):
        self.box_s, self.shares, self.allowed = box_s, shares, []

    def confine(self, cutoff, budget, allowed_s):
        self.allowed.append(allowed_s)


@pytest.mark.parametrize(
    ("box_s", "asked"),
    [
        (1e-3, 1),  # boxes alone end soon, so the half is not needed
        (1e3, 2),  # they do not
    ],
)
def test_a_cover_may_take_a_part_of_the_time_that_boxes_take(box_s, asked, monkeypatch):
    paused, cover = paused_search(Budget(time_s=100.0)), Asked(box_s)
    monkeypatch.setattr(Search, "estimate", lambda self: 5000.0)
    space_search._with_cover(space_search.Course(None, paused), cover, None)
    most = [space_search.WORTH * 5000.0 * box_s, space_search.COVER_SHARE * 100.0]
    assert cover.allowed == pytest.approx([min(most)] * asked, rel=0.01)


def test_a_share_may_take_less_time_if_boxes_alone_prove_the_whole(monkeypatch):
    """It only raises the lower bound until then; 10 of 42 s were spent on a quarter."""
    monkeypatch.setattr(Search, "estimate", lambda self: 5000.0)
    asked = {}
    for box_s in (1e-3, 0.02):  # 5 s and 100 s for all boxes
        paused, cover = paused_search(Budget(time_s=100.0)), Asked(box_s, (0.25, 1.0))
        space_search._with_cover(space_search.Course(None, paused), cover, None)
        asked[box_s] = cover.allowed[0]
    assert asked[1e-3] == pytest.approx(space_search.PREVIEW * 5.0, rel=0.01)
    assert asked[0.02] == pytest.approx(space_search.WORTH * 100.0, rel=0.01)


def test_a_cover_that_gave_up_a_share_is_not_asked_for_larger_ones(monkeypatch):
    """They take longer: four attempts, all given up, took 7 s of a run."""
    paused, cover = paused_search(Budget(time_s=100.0)), Asked(1e3, (0.25, 1.0, 0.5, 0.125))
    monkeypatch.setattr(Search, "estimate", lambda self: 5000.0)
    space_search._with_cover(space_search.Course(None, paused), cover, None)
    assert len(cover.allowed) == 2


def test_a_cover_without_a_time_per_box_needs_no_estimate(monkeypatch):
    paused, cover = paused_search(Budget(time_s=100.0)), Asked(np.inf)
    monkeypatch.setattr(Search, "estimate", lambda self: pytest.fail("estimated"))
    space_search._with_cover(space_search.Course(None, paused), cover, None)
    assert len(cover.allowed) == 2


def test_nothing_is_estimated_without_open_boxes():
    paused = paused_search()
    paused.narrow(Confined(Boxes(np.empty((0, 2)), np.empty((0, 2))), 1e-4))
    assert paused.estimate() == 0.0
    assert paused.prospect == Prospect(paused.n_nodes - paused.n_nodes_before)
