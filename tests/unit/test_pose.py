"""Scale and nearest rotation of a linear map."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dcreg.problem import nearest_rotation, scale_of


@pytest.mark.parametrize("mirrored", [False, True])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_nearest_rotation_is_proper_and_nearer_than_others(mirrored: bool, seed: int) -> None:
    generator = np.random.default_rng(seed)
    matrix = generator.standard_normal((3, 3))
    if (np.linalg.det(matrix) < 0) != mirrored:
        matrix[0] *= -1
    found = nearest_rotation(matrix)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    others = Rotation.random(200, random_state=generator).as_matrix()
    distances = np.linalg.norm(others - matrix, axis=(1, 2))
    assert np.linalg.norm(found - matrix) <= distances.min() + 1e-12


@pytest.mark.parametrize("d", [2, 3])
def test_scale_of_a_similarity(d: int) -> None:
    pose = np.eye(d + 1)
    pose[:d, :d] = 1.7 * nearest_rotation(np.random.default_rng(0).standard_normal((d, d)))
    pose[:d, d] = 5.0
    assert scale_of(pose) == pytest.approx(1.7)
