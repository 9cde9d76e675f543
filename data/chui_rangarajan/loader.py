"""Chui and Rangarajan's synthesized 2D sets: fish and character, five tests, 100 samples per level.

A sample is read from a mirror's pack (all samples of a shape and test in one file) or from the
original file of just that sample; both give the same arrays.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from data.contract import Axis, DataError, File, RawInstance, RecordedDataset
from data.fetch import fetch
from data.sampling import reference_pose

# The originals' word for the character.
FILE_WORD = {"fish": "fish", "character": "chinese"}


@lru_cache(maxsize=1)
def _checksums() -> dict[str, np.ndarray]:
    """Git blob ids of the originals, one (levels, trials, 20) byte array per shape and test."""
    with np.load(Path(__file__).with_name("checksums.npz")) as table:
        return dict(table)


@lru_cache(maxsize=4)
def _pack(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as pack:
        return {key: pack[key] for key in pack.files if not key.startswith(("w_", "git_"))}


class Loader(RecordedDataset):
    """``fish`` (98 points) and ``character`` (105 points).

    Levels are 1, 2, ... as in the file names, trial k is sample k + 1. The truth is the similarity
    fitted to the true pairs: a warp has no pose of its own. Row i of the source belongs to row i
    of the target; outliers are the target's last rows.
    """

    def takes_n_points(self, test: str) -> bool:
        return False

    def shapes(self) -> list[str]:
        return list(FILE_WORD)

    def tests(self) -> dict[str, Axis]:
        return {
            test: Axis(
                levels=tuple(range(1, len(entry["values"]) + 1)),
                values=tuple(entry["values"]),
                label=entry["label"],
                n_trials=self.card.parameters["n_trials"],
            )
            for test, entry in self.card.parameters["tests"].items()
        }

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        stem = f"{FILE_WORD[shape]}_{test}"
        pack = self.card.file(f"2d/chui-rangarajan/{stem}.npz")
        return [fetch(pack, self._original(stem, int(level), trial))]

    def _original(self, stem: str, level: int, trial: int) -> File:
        name = f"save_{stem}_{level}_{trial + 1}.mat"
        return File(
            dataset=self.name,
            path=f"2d/chui-rangarajan/raw/{name}",
            url=f"{self.card.parameters['originals']}/{name}",
            git_sha1=bytes(_checksums()[stem][level - 1, trial]).hex(),
        )

    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        if n_points is not None:
            raise DataError(f"dataset {self.name} has a fixed number of points; remove n_points")
        (path,) = self.files(shape, test, level, trial)
        read = _from_pack if path.suffix == ".npz" else _from_original
        source, target, n_pairs = read(path, int(level), trial)
        from dcreg.problem import scale_of

        pairs = np.column_stack([np.arange(n_pairs)] * 2)
        scale_range = tuple(self.card.parameters["scale_range"])
        T_true = reference_pose(source, target, pairs, scale_range)
        return RawInstance(
            source,
            target,
            pairs,
            T_true,
            scale_range,
            {"scale_true": scale_of(T_true)},
        )


def _from_pack(path: Path, level: int, trial: int) -> tuple[np.ndarray, np.ndarray, int]:
    pack = _pack(path)
    warped = pack[f"y2_L{level}"][trial]
    observed = pack.get(f"y2a_L{level}", pack[f"y2_L{level}"])[trial]
    source = pack["x1"]
    if f"perm_L{level}" in pack:
        source = source[pack[f"perm_L{level}"][trial]]
    return source.copy(), observed.copy(), len(warped)


def _from_original(path: Path, level: int, trial: int) -> tuple[np.ndarray, np.ndarray, int]:
    sample = loadmat(path, variable_names=["x1", "y2", "y2a"])
    # Matlab's column order would change the last digits of computed values.
    source, target = (np.ascontiguousarray(sample[name]) for name in ("x1", "y2a"))
    return source, target, len(sample["y2"])
