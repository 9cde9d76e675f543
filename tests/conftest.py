"""Shared fixtures and the Hypothesis profile: fixed seeds, so that a red test stays red."""

import os

import hypothesis
import numpy as np
import pytest

hypothesis.settings.register_profile(
    "fixed", derandomize=True, deadline=None, max_examples=int(os.environ.get("EXAMPLES", "60"))
)
hypothesis.settings.load_profile("fixed")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260326)
