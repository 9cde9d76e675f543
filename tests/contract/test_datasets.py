"""Requirements on every dataset; new ones are found by discovery."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from data.contract import PrototypeDataset, RecordedDataset
from data.fetch import UnavailableError, cache_root, fetch
from data.registry import datasets
from dcreg.problem import apply_pose
from workflows.disturb import make_instance

MIRROR = os.environ.get("DCREG_DATA_MIRROR", "")
ALL = datasets()
# A recorded dataset's first and last level of each test are enough here.
RECORDED = [
    pytest.param(dataset, shape, test, level, id=f"{name}-{shape}-{test}-{level:g}")
    for name, dataset in ALL.items()
    # Without files on the card it is a user's own copy: test_photographs.py has one made up.
    for shape in (
        dataset.shapes()[:2] if isinstance(dataset, RecordedDataset) and dataset.card.files else []
    )
    for test, axis in dataset.tests().items()
    for levels in [[level for level in axis.levels if dataset.has(shape, test, level, 0)]]
    for level in {levels[0], levels[-1]}
]
PROTOTYPES = [
    pytest.param(dataset, shape, id=f"{name}-{shape}")
    for name, dataset in ALL.items()
    if isinstance(dataset, PrototypeDataset)
    for shape in dataset.shapes()
]


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """One cache for all tests of this module, separate from the checkout's."""
    root = tmp_path_factory.getbasetemp() / "contract-cache"
    monkeypatch.setenv("DCREG_DATA_CACHE", str(root))


def loaded(call):
    """Return the value, or skip and name the missing file."""
    try:
        return call()
    except UnavailableError as error:
        if MIRROR:
            raise
        pytest.skip(f"no mirror and no network: {str(error).splitlines()[0]}")


def test_the_expected_datasets_are_there():
    assert {"embedded", "chui_rangarajan", "lian_apm", "horse", "dino", "threedmatch"} <= set(ALL)


@pytest.mark.parametrize("name", ALL)
def test_cards_are_complete(name):
    card = ALL[name].card
    assert card.title
    assert card.licence
    assert card.citation
    assert ALL[name].shapes()
    for shape in ALL[name].shapes():
        assert ALL[name].dim(shape) in (2, 3)
    for file in card.files:
        assert file.dataset == name
        assert file.size
        if file.url is None:  # a pack: the loader must know originals
            assert "originals" in card.parameters
        else:
            # A branch name in an address would let the file change under its checksum.
            assert any(len(part) == 40 for part in file.url.split("/")), file.url


@pytest.mark.parametrize("name", ALL)
def test_listing_needs_no_file(name, monkeypatch, tmp_path):
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path))
    monkeypatch.delenv("DCREG_DATA_MIRROR", raising=False)
    ALL[name].shapes()
    for axis in ALL[name].tests().values():
        assert len(axis.levels) == len(axis.values) > 0
        assert axis.n_trials > 0
        assert axis.label
    assert not list(tmp_path.iterdir())
    assert cache_root() == tmp_path


@pytest.mark.skipif(not Path(MIRROR).is_dir() or not MIRROR, reason="DCREG_DATA_MIRROR is not set")
@pytest.mark.parametrize("name", ALL)
def test_every_file_of_the_card_is_as_described(name):
    for file in ALL[name].card.files:
        assert fetch(file).stat().st_size == file.size  # fetch compares the checksum


@pytest.mark.parametrize(("dataset", "shape"), PROTOTYPES)
def test_prototypes(dataset, shape):
    points = loaded(lambda: dataset.prototype(shape))
    assert points.dtype == float
    assert points.shape[1] == dataset.dim(shape)
    assert np.isfinite(points).all()
    low, high = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose(low + high, 0, atol=1e-12)
    assert (high - low).max() == pytest.approx(1)
    assert len(np.unique(points, axis=0)) == len(points)
    assert len(dataset.prototype(shape, 40)) == 40
    points[:] = 0  # changes by one caller must not reach the next
    assert np.ptp(dataset.prototype(shape)) > 0.5


@pytest.mark.parametrize(("dataset", "shape", "test", "level"), RECORDED)
def test_recorded_instances(dataset, shape, test, level):
    made = loaded(lambda: make_instance(dataset, shape, test, level, 0))
    d = dataset.dim(shape)
    assert made.source.shape[1] == made.target.shape[1] == d
    assert made.source.dtype == made.target.dtype == float
    assert made.T_true.shape == (d + 1, d + 1)
    scale = np.linalg.det(made.T_true[:d, :d]) ** (1 / d)
    assert scale > 0
    np.testing.assert_allclose(
        made.T_true[:d, :d] @ made.T_true[:d, :d].T, scale**2 * np.eye(d), atol=1e-4
    )
    i, j = made.pairs.T
    assert len(set(i)) == len(set(j)) == len(made.pairs) > 3
    assert i.max() < len(made.source)
    assert j.max() < len(made.target)
    # Pairing at random leaves the whole spread; the strongest recorded warps leave about 0.6 of it.
    moved = apply_pose(made.T_true, made.source[i])
    residual = np.sqrt(((moved - made.target[j]) ** 2).sum(axis=1).mean())
    spread = np.sqrt(((made.target[j] - made.target[j].mean(axis=0)) ** 2).sum(axis=1).mean())
    assert residual < 0.75 * spread
    again = make_instance(dataset, shape, test, level, 0)
    np.testing.assert_array_equal(made.target, again.target)
    np.testing.assert_array_equal(made.pairs, again.pairs)
