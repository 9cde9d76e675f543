"""Open boxes leave in the order of the heap that Python ships."""

import heapq

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcreg.search.boxes import OpenNodes
from dcreg.search.budget import Workers

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
def test_best_bound_then_larger_then_older(batches, has_hints):
    nodes, reference, serial = OpenNodes(2), [], 0
    for boxes, count, cutoff in batches:
        bounds = np.array([float(bound) for bound, _ in boxes])
        lower = np.zeros((len(boxes), 2))
        upper = np.array([[float(size), serial + i] for i, (_, size) in enumerate(boxes)])
        upper = upper.reshape(-1, 2)
        for i, bound in enumerate(bounds):
            heapq.heappush(reference, (bound, -upper[i].sum(), serial + i, tuple(upper[i])))
        serial += len(boxes)
        hints = upper.astype(np.uint16) if has_hints else None
        nodes.push(lower, upper, bounds, hints)
        assert len(nodes) == len(reference)
        assert nodes.lower_bound == (reference[0][0] if reference else np.inf)
        _, taken, taken_bounds, taken_hints = nodes.pop(count, cutoff)
        if has_hints:
            assert (taken_hints == taken.astype(np.uint16)).all()
        else:
            assert taken_hints is None
        expected = []
        while reference and len(expected) < count and reference[0][0] < cutoff:
            expected.append(heapq.heappop(reference))
        assert [tuple(box) for box in taken] == [entry[3] for entry in expected]
        assert taken_bounds.tolist() == [entry[0] for entry in expected]
        assert len(nodes) == len(reference)


@given(st.integers(1, 4), st.integers(0, 100))
@settings(max_examples=60)
def test_workers_do_everything_once(threads, count):
    done = np.zeros(count, int)

    def work(part):
        done[part] += 1
        return part.stop - part.start

    assert Workers(threads).run(work, count) == count
    assert (done == 1).all()


@pytest.mark.parametrize("threads", [1, 3])
def test_a_worker_error_reaches_the_caller(threads):
    def work(part):
        if part.start == 0:
            raise ValueError("first slice")
        return 0

    with pytest.raises(ValueError, match="first slice"):
        Workers(threads).run(work, 50)
