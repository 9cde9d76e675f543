"""3DMatch test fragments: a small frozen list of pairs, and the official lists on whole clouds.

Both tables of pairs are made by select_pairs.py.
"""

from __future__ import annotations

import csv
import io
import pickle
from collections import Counter
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from data.contract import Axis, DataError, File, RawInstance, RecordedDataset
from data.fetch import fetch
from data.sampling import mutual_nearest, voxel_downsample
from data.scans import scan_instance
from dcreg.problem import apply_pose, nearest_rotation

HERE = Path(__file__).parent
LISTS = ("3DMatch", "3DLoMatch")
QUICK = 16  # the quick version of a list has every 16th pair
ORIENTED = "-oriented"  # tests whose features are made with oriented normals
BINS = 10  # of the overlap, which are the levels of the official lists


def read_csv(name: str) -> list[dict[str, str]]:
    """Rows of a table of this folder."""
    with open(HERE / name, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


class _ArraysOnly(pickle.Unpickler):
    """Opens pickles of plain values and NumPy arrays, and nothing that could run code."""

    NUMPY = ("_reconstruct", "ndarray", "dtype", "scalar", "_frombuffer")

    def find_class(self, module: str, name: str) -> Any:
        is_array = module.split(".")[0] == "numpy" and name in self.NUMPY
        if is_array or (module, name) == ("_codecs", "encode"):  # how protocol 2 writes bytes
            return super().find_class(module, name)
        raise DataError(
            f"a 3DMatch pickle asks for {module}.{name}; the file differs from the official one"
        )


def read_torch_array(path: Path) -> np.ndarray:
    """The one array of a file in torch's old format: three header objects, then the array."""
    with open(path, "rb") as stream:
        for _ in range(3):
            _ArraysOnly(stream).load()
        return _ArraysOnly(stream).load()


@cache
def read_metadata(path: Path) -> list[dict[str, Any]]:
    """Pairs of the official list: scene, fragments, overlap, rotation, translation."""
    return _ArraysOnly(io.BytesIO(path.read_bytes())).load()


@lru_cache(maxsize=64)
def fragment(path: Path, number: int) -> np.ndarray:
    """Read a whole fragment from the pack of a mirror or from its original file."""
    if path.suffix == ".npz":
        with np.load(path) as pack:
            return pack[f"cloud_{number:02d}"].astype(float)
    # Packs contain float32 without loss: the originals are float32 values in a float64 array.
    return read_torch_array(path).astype(np.float32).astype(float)


def official_tests() -> dict[str, tuple[str, int]]:
    """Return the tests on the official lists: the list, and the step between its pairs."""
    return {
        f"{name}{size}{normals}": (name, step)
        for normals in ("", ORIENTED)
        for size, step in (("", 1), ("-quick", QUICK))
        for name in LISTS
    }


class Loader(RecordedDataset):
    """Shapes are scenes. ``T_true`` maps fragment ``src_j`` (source) into the frame of ``ref_i``.

    Test ``overlap``: one pair per scene and level (the nominal overlap), with few points per fragment.
    Tests ``3DMatch`` and ``3DLoMatch``: all pairs of the official lists on whole clouds, with the matches
    that all methods share. ``-quick``: every 16th pair of a list. ``-oriented``: the same pairs, with
    normals oriented towards the sensor before features are computed. A level of these tests is the
    minimum overlap of a bin, a trial the index among the scene's pairs in it; the grid is incomplete.

    ``info["overlap"]`` is the official value, a fraction of the target. Lengths are in metres.
    """

    def shapes(self) -> list[str]:
        return sorted({row["scene"] for row in read_csv("pairs.csv")})

    def tests(self) -> dict[str, Axis]:
        levels = tuple(sorted({float(row["level"]) for row in read_csv("pairs.csv")}))
        tests = {"overlap": Axis(levels=levels, values=levels, label="overlap", n_trials=1)}
        n_trials = 1 + max(trial for *_, trial in self.pairs)
        for test in official_tests():
            levels = tuple(sorted({key[2] for key in self.pairs if key[1] == test}))
            tests[test] = Axis(levels=levels, values=levels, label="overlap", n_trials=n_trials)
        return tests

    def takes_n_points(self, test: str) -> bool:
        return test == "overlap"  # the official lists are on whole clouds

    def has(self, shape: str, test: str, level: float, trial: int) -> bool:
        return (shape, test, level, trial) in self.pairs

    @cached_property
    def pairs(self) -> dict[tuple[str, str, float, int], dict[str, str]]:
        """The pair of every instance, by its axes."""
        pairs = {
            (row["scene"], "overlap", float(row["level"]), 0): row for row in read_csv("pairs.csv")
        }
        rows = read_csv("lists.csv")
        for test, (name, step) in official_tests().items():
            count: Counter[tuple[str, float]] = Counter()
            for row in [row for row in rows if row["set"] == name][::step]:
                level = int(BINS * float(row["overlap"])) / BINS
                place = (row["scene"], level)
                pairs[row["scene"], test, level, count[place]] = row
                count[place] += 1
        return pairs

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        """Return the fragment files of source and target, and the list with the pose."""
        pair = self.pairs[shape, test, level, trial]
        fragments = [self.fetch_fragment(shape, int(pair[side])) for side in ("src_j", "ref_i")]
        return [*fragments, fetch(self.card.file(f"3dmatch/meta/{pair['set']}.pkl"))]

    def fetch_fragment(self, scene: str, number: int) -> Path:
        """Return the file that holds a fragment: the pack of its scene, or the original."""
        row = next(
            row
            for row in read_csv("fragments.csv")
            if row["scene"] == scene and int(row["fragment"]) == number
        )
        name = f"{scene}/cloud_bin_{number}.pth"
        original = File(
            dataset=self.name,
            path=f"3dmatch/raw/{name}",
            url=f"{self.card.parameters['originals']}/{name}",
            sha256=row["sha256"],
            size=int(row["size"]),
        )
        return fetch(self.card.file(f"3dmatch/fragments/{scene}.npz"), original)

    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        pair = self.pairs[shape, test, level, trial]
        i, j = int(pair["ref_i"]), int(pair["src_j"])
        source, target, metadata = self.files(shape, test, level, trial)
        official = next(
            entry
            for entry in read_metadata(metadata)
            if (entry["scene_name"], entry["frag_id0"], entry["frag_id1"]) == (shape, i, j)
        )
        T_true = np.eye(4)
        # The official matrices deviate from rotations by up to 6e-4.
        T_true[:3, :3] = nearest_rotation(official["rotation"])
        T_true[:3, 3] = official["translation"]
        parameters = self.card.parameters
        clouds = fragment(source, j), fragment(target, i)
        info: dict[str, float | str] = {
            "overlap": float(official["overlap"]),
            "set": pair["set"],
            "ref": i,
            "src": j,
        }
        if test == "overlap":
            return scan_instance(
                *clouds,
                T_true,
                voxel=parameters["voxel"],
                n_points=n_points or parameters["n_points"],
                tolerance=parameters["tolerance"],
                info=info,
            )
        if n_points is not None:
            raise DataError(f"dataset {self.name}: {test} uses whole clouds; remove n_points")
        x, y = (voxel_downsample(cloud, parameters["voxel"]) for cloud in clouds)
        threshold = parameters["inlier_distance"]
        pairs = mutual_nearest(apply_pose(T_true, x), y, threshold)
        radii = parameters["normal_radius"], parameters["feature_radius"]
        viewpoint = tuple(parameters["viewpoint"]) if test.endswith(ORIENTED) else None
        return RawInstance(
            x, y, pairs, T_true, (1.0, 1.0), info, threshold, radii, viewpoint=viewpoint
        )
