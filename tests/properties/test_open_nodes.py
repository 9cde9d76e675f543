"""Open boxes leave in the order of the heap that Python ships."""

import heapq
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcreg.families.dc.bounds import IntervalBound
from dcreg.families.protocol import SpaceBound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search.boxes import Boxes, OpenNodes

# few distinct bounds and sizes: ties are what the order is about
batches = st.lists(
    st.tuples(
        st.lists(st.tuples(st.integers(0, 3), st.integers(1, 3)), max_size=90),
        st.integers(1, 60),
        st.sampled_from([0.5, 1.5, 2.5, np.inf]),
    ),
    max_size=8,
)


@given(batches, st.booleans())
@settings(max_examples=150)
def test_best_bound_then_larger_then_older(batches, has_warm_starts):
    nodes, reference, serial = OpenNodes(2), [], 0
    for boxes, count, cutoff in batches:
        bounds = np.array([float(bound) for bound, _ in boxes])
        lower = np.zeros((len(boxes), 2))
        upper = np.array([[float(size), serial + i] for i, (_, size) in enumerate(boxes)])
        upper = upper.reshape(-1, 2)
        for i, bound in enumerate(bounds):
            heapq.heappush(reference, (bound, -upper[i].sum(), serial + i, tuple(upper[i])))
        serial += len(boxes)
        warm_starts = upper.astype(np.uint16) if has_warm_starts else None
        nodes.push(Boxes(lower, upper, bounds, warm_starts))
        assert len(nodes) == len(reference)
        assert nodes.lower_bound == (reference[0][0] if reference else np.inf)
        taken = nodes.pop(count, cutoff)
        if has_warm_starts:
            assert (taken.warm_start == taken.upper.astype(np.uint16)).all()
        else:
            assert taken.warm_start is None
        expected = []
        while reference and len(expected) < count and reference[0][0] < cutoff:
            expected.append(heapq.heappop(reference))
        assert [tuple(box) for box in taken.upper] == [entry[3] for entry in expected]
        assert taken.bounds.tolist() == [entry[0] for entry in expected]
        assert len(nodes) == len(reference)


def one_pair_bound(threads):
    space = Similarity2D(np.zeros((1, 2)), np.ones((1, 2)), 1, (0.5, 1.5))
    bound = IntervalBound(space, threads=threads)
    bound.slice_pairs = 1
    return bound


@given(st.integers(1, 4), st.integers(0, 100))
@settings(max_examples=60)
def test_every_slice_is_mapped_once(threads, count):
    bound = one_pair_bound(threads)
    done = np.zeros(count, int)

    def work(part):
        done[part] += 1
        return part.stop - part.start

    bound.map_slices(count, work)
    assert bound.n_assignments == count
    assert (done == 1).all()


@pytest.mark.parametrize(("per_slice", "n_threads"), [(0.9, 1), (1.0, 2)])
def test_work_is_shared_from_two_slices_on(per_slice, n_threads):
    bound = one_pair_bound(2)
    bound.slice_pairs = SpaceBound.slice_pairs
    both, seen = threading.Barrier(n_threads, timeout=10.0), set()

    def work(part):
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            both.wait()
        return 0

    bound.map_slices(int(2 * per_slice * bound.slice_pairs), work)
    assert len(seen) == n_threads


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_in_a_thread_reaches_the_caller(threads):
    def work(part):
        if part.start == 0:
            raise ValueError("first slice")
        return 0

    with pytest.raises(ValueError, match="first slice"):
        one_pair_bound(threads).map_slices(50, work)
