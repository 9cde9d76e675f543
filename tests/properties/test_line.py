"""The verification's matching of numbers on a line, against assignments."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dcreg.certificate.assignment import Line, cheapest_pairs


@st.composite
def lists_of_numbers(draw):
    """Lists of numbers, and numbers to match k of them with; ties and equal lists among them."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, m = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    k = draw(st.integers(1, min(n, m)))
    assume(not n == m == k)
    lists, values = generator.random((draw(st.integers(1, 5)), n)), np.sort(generator.random(m))
    if draw(st.booleans()):
        lists, values = np.round(lists, 1), np.round(values, 1)
    return lists, values, k, generator


@given(lists_of_numbers(), st.floats(0.1, 2.0))
def test_matching_on_a_line_is_the_cheapest_of_all(case, share):
    lists, values, k, _ = case
    ordered, line = np.sort(lists, axis=1), Line(values, lists.shape[1], k)
    exact = []
    for row in lists:
        costs, columns = cheapest_pairs((row[:, None] - values) ** 2, k)
        exact.append(costs[np.arange(len(row)), columns].sum())
    for _ in range(2):  # the second call starts from the dual variables of the first
        found = line.bounds(ordered, ordered, np.inf)
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)
    needed = share * max(exact[0], 1e-9)
    found = line.bounds(ordered, ordered, needed)
    assert (found <= np.array(exact) + 1e-12).all()
    assert (found[np.array(exact) >= needed + 1e-12] >= needed - 1e-12).all()


@given(lists_of_numbers(), st.sampled_from([1e-3, 0.1, 1.0]), st.floats(0.0, 2.0))
def test_matching_with_intervals_bounds_that_of_all_numbers_in_them(case, size, share):
    lists, values, k, generator = case
    low = lists - size * generator.random(lists.shape)
    high = lists + size * generator.random(lists.shape)
    line = Line(values, lists.shape[1], k)
    exact = line.bounds(np.sort(lists, axis=1), np.sort(lists, axis=1), np.inf)
    for needed in (np.inf, share * exact.max()):
        bounds = line.bounds(np.sort(low, axis=1), np.sort(high, axis=1), needed)
        assert (bounds <= exact + 1e-12).all()


@pytest.mark.parametrize("offset", [1e-12, 1e-9, 1e-3])
def test_lists_are_matched_after_others_that_cost_far_less(offset):
    """The scale of the first costs must not be the scale of the later ones."""
    line, far = Line(np.arange(7.0), 2, 2), np.array([[2.25, 4.5]])
    near = np.array([[1.0, 2.0]]) + offset
    line.bounds(near, near, offset**2)
    np.testing.assert_allclose(line.bounds(far, far, np.inf), [0.0625 + 0.25])
