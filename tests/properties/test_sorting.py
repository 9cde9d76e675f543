"""Columns sorted side by side against NumPy, and the objective made of them against the general one."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.assignment.kernels.sorting import COLUMNS, sort_columns
from dcreg.families.translation3d.kernels.line import objectives_on_line
from dcreg.jit import NEVER

KINDS = {
    "uniform": lambda generator, shape: generator.random(shape),
    "few values": lambda generator, shape: generator.integers(0, 3, shape).astype(float),
    "all equal": lambda generator, shape: np.full(shape, generator.random()),
    "clusters": lambda generator, shape: (
        generator.choice([0.0, 1e9], shape) + generator.random(shape)
    ),
    "neighbours": lambda generator, shape: 1.0 + generator.integers(0, 9, shape) * 2.0**-52,
    "any magnitude": lambda generator, shape: 10.0 ** generator.uniform(-307, 308, shape),
    "subnormal": lambda generator, shape: generator.integers(0, 50, shape) * 5e-324,
    "sorted": lambda generator, shape: np.sort(generator.random(shape), axis=0),
    "reversed": lambda generator, shape: np.sort(generator.random(shape), axis=0)[::-1].copy(),
}
ANY = st.floats(min_value=0.0, allow_infinity=False)


def check_sorts(table):
    expected = np.sort(table, axis=0)
    sort_columns(table)
    np.testing.assert_array_equal(table.view(np.int64), expected.view(np.int64))


@pytest.mark.parametrize("kind", KINDS)
def test_every_small_size(kind, rng):
    for n in range(1, 300):
        check_sorts(KINDS[kind](rng, (n, COLUMNS)))


@given(st.sampled_from(list(KINDS)), st.integers(1, 3000), st.integers(0, 2**32 - 1))
@example("uniform", 2049, 0)
def test_any_size(kind, n, seed):
    check_sorts(KINDS[kind](np.random.default_rng(seed), (n, COLUMNS)))


@given(st.lists(st.tuples(*[ANY] * COLUMNS), min_size=1, max_size=40))
def test_any_numbers(rows):
    check_sorts(np.array(rows))


def test_zeros_and_ones_in_every_order():
    """A network that sorts these sorts everything: all of them up to 12 rows, many beyond."""
    for n in range(1, 13):
        words = np.arange(2**n)
        columns = ((words >> np.arange(n)[:, None]) & 1).astype(float)
        columns = np.pad(columns, ((0, 0), (0, -columns.shape[1] % COLUMNS)))
        for first in range(0, columns.shape[1], COLUMNS):
            check_sorts(columns[:, first : first + COLUMNS].copy())


@settings(max_examples=40)
@given(
    st.integers(1, 12),
    st.integers(1, 12),
    st.integers(1, 20),
    st.floats(0.0, 1.0),
    st.integers(0, 2**32 - 1),
)
def test_objectives_equal_the_general_assignment(n, m, rows, share, seed):
    generator = np.random.default_rng(seed)
    source, thetas = generator.standard_normal((n, 3)), generator.standard_normal((rows, 3))
    target = generator.random(m)
    k = 1 + round(share * (min(n, m) - 1))
    values = np.empty(rows)
    by_axis = np.ascontiguousarray(source.T)
    assert objectives_on_line(by_axis, np.sort(target), k, thetas, values) == rows
    for theta, value in zip(thetas, values, strict=True):
        cost = (np.linalg.norm(source + theta, axis=1)[:, None] - target) ** 2
        assert value == pytest.approx(k_assignment(cost, k, NEVER)[0], rel=1e-10, abs=1e-11)


@pytest.mark.parametrize("k", [30, 70])
def test_values_do_not_depend_on_how_rows_are_sliced(k, rng):
    source, target, thetas = rng.random((3, 70)), np.sort(rng.random(70)), rng.random((41, 3))
    whole = np.empty(41)
    objectives_on_line(source, target, k, thetas, whole)
    for size in (1, 2, 7, COLUMNS, 9, 20):
        parts = np.empty(41)
        for first in range(0, 41, size):
            part = slice(first, first + size)
            objectives_on_line(source, target, k, thetas[part], parts[part])
        np.testing.assert_array_equal(parts, whole)
