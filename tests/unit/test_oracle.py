"""True pairs reach methods with the oracle front end, among random ones, and no other method."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from baselines import registry
from workflows.config import Experiment
from workflows.instances import (
    Problem,
    Truth,
    content_digest,
    with_oracle,
    write_problems,
    write_truths,
)
from workflows.stages import solve as solving

EXPERIMENT = Experiment(
    name="oracle",
    datasets=[{"dataset": "embedded", "tests": {"noise": [0.01]}}],
    methods=[
        {"name": "favoured", "baseline": "gnc_tls", "options": {"front_end": "oracle"}},
        {"name": "plain", "baseline": "gnc_tls"},
    ],
)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Return an instance with known pairs, and its true pose separately."""
    generator = np.random.default_rng(0)
    source = generator.random((30, 3))
    order = generator.permutation(30)
    problem = Problem("one", "rigid3d", source, source[order] + 1.0, (1.0, 1.0), 30, 0.01)
    T_true = np.eye(4)
    T_true[:3, 3] = 1.0
    pairs = np.column_stack([order, np.arange(30)])
    write_problems(tmp_path / "instances.npz", [problem])
    write_truths(tmp_path / "truth.npz", [Truth("one", T_true, pairs)])
    return tmp_path / "instances.npz", tmp_path / "truth.npz"


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list:
    """Return the instances for a worker, which is not started."""
    seen: list = []
    monkeypatch.setattr(solving, "_rows", lambda *inputs: seen.extend(inputs[2]) or iter(()))
    return seen


@pytest.mark.parametrize(("name", "n_pairs"), [("favoured", 60), ("plain", None)])
def test_only_a_favoured_method_gets_pairs(
    files: tuple[Path, Path], given: list, name: str, n_pairs: int | None
) -> None:
    instances, truth = files
    out = instances.parent / name / "chunk.parquet"
    solving.solve(EXPERIMENT, EXPERIMENT.method(name), instances, out, lambda _: None, truth)
    (instance,) = given
    pairs = instance.oracle_pairs
    assert (None if pairs is None else len(pairs)) == n_pairs  # half of them random


def test_the_share_of_outliers_is_read_from_options_and_card() -> None:
    assert registry.oracle_outliers("gnc_tls", {}) is None
    assert registry.oracle_outliers("icp", {}) is None
    assert registry.oracle_outliers("gnc_tls", {"front_end": "oracle"}) == 0.5
    asked = {"front_end": "oracle", "oracle_outliers": 0.9}
    assert registry.oracle_outliers("gnc_tls", asked) == 0.9


def test_oracle_pairs_change_the_digest_and_their_absence_does_not(rng) -> None:
    problem = Problem("p", "rigid3d", rng.random((9, 3)), rng.random((9, 3)), (1.0, 1.0), 9, 0.1)
    instance = problem.for_solver(1.0, 0)
    truth = Truth("p", np.eye(4), np.column_stack([np.arange(9), np.arange(9)]))
    digests = [content_digest(with_oracle(instance, truth, share)) for share in (0.5, 0.5, 0.6)]
    assert digests[0] == digests[1] != digests[2]
    assert content_digest(instance) not in digests
