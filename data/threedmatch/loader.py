"""3DMatch test fragments over a frozen list of pairs, 5 per scene (see select_pairs.py)."""

from __future__ import annotations

import csv
import io
import pickle
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from data.contract import Axis, DataError, File, RawInstance, RecordedDataset
from data.fetch import fetch
from data.scans import scan_instance
from dcreg.problem import nearest_rotation

HERE = Path(__file__).parent


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
        raise DataError(f"a 3DMatch pickle asks for {module}.{name}; it is not the official file")


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
def _fragment(path: Path, number: int) -> np.ndarray:
    if path.suffix == ".npz":
        with np.load(path) as pack:
            return pack[f"cloud_{number:02d}"].astype(float)
    # Packs hold float32, without loss: the originals are float32 values in a float64 array.
    return read_torch_array(path).astype(np.float32).astype(float)


class Loader(RecordedDataset):
    """Shapes are scenes; test ``overlap``, its levels the nominal overlap of the chosen pair.

    ``T_true`` maps fragment ``src_j`` (source) into the frame of ``ref_i`` (target), metres.
    ``info["overlap"]`` is the official one, a fraction of the target.
    """

    def shapes(self) -> list[str]:
        return sorted({row["scene"] for row in read_csv("pairs.csv")})

    def tests(self) -> dict[str, Axis]:
        levels = tuple(sorted({float(row["level"]) for row in read_csv("pairs.csv")}))
        return {"overlap": Axis(levels=levels, values=levels, label="overlap", n_trials=1)}

    def _pair(self, scene: str, level: float) -> dict[str, str]:
        return next(
            row
            for row in read_csv("pairs.csv")
            if row["scene"] == scene and float(row["level"]) == level
        )

    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        """The source's fragment file, the target's, and the list with the pose."""
        pair = self._pair(shape, level)
        fragments = [self._fetch_fragment(shape, int(pair[side])) for side in ("src_j", "ref_i")]
        return [*fragments, fetch(self.card.file(f"3dmatch/meta/{pair['set']}.pkl"))]

    def _fetch_fragment(self, scene: str, number: int) -> Path:
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
        pair = self._pair(shape, level)
        i, j = int(pair["ref_i"]), int(pair["src_j"])
        source, target, metadata = self.files(shape, test, level, trial)
        official = next(
            entry
            for entry in read_metadata(metadata)
            if (entry["scene_name"], entry["frag_id0"], entry["frag_id1"]) == (shape, i, j)
        )
        T_true = np.eye(4)
        # The official matrices are off by up to 6e-4 from being rotations.
        T_true[:3, :3] = nearest_rotation(official["rotation"])
        T_true[:3, 3] = official["translation"]
        parameters = self.card.parameters
        return scan_instance(
            _fragment(source, j),
            _fragment(target, i),
            T_true,
            voxel=parameters["voxel"],
            n_points=n_points or parameters["n_points"],
            tolerance=parameters["tolerance"],
            info={"overlap": float(official["overlap"]), "set": pair["set"], "ref": i, "src": j},
        )
