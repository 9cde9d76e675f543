"""The warm-up of the methods that search rotations compiles the search."""

from __future__ import annotations

import numpy as np
import pytest

from baselines import registry
from baselines._shared import rotation_search
from baselines.contract import Instance, Limits


@pytest.mark.parametrize("name", ["frs", "gots", "gore"])
def test_solves_compile_nothing_after_the_warm_up(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the first solve with a search exceeds its limit by seconds."""
    compiled, runs = rotation_search.divide_cubes, []

    def counted(*arguments: object) -> int:
        runs.append(name)
        return compiled(*arguments)

    monkeypatch.setattr(rotation_search, "divide_cubes", counted)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 20, 3))
    instance = Instance("random", *points, "rigid3d", 12, (1, 1), 0.04, 0)
    method = registry.load(name)
    method.warm_up(instance)
    assert runs
    n_compiled = len(compiled.signatures)
    runs.clear()
    method.solve(instance, Limits(0.5))
    assert runs
    assert len(compiled.signatures) == n_compiled
