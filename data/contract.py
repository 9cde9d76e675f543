"""Datasets: their cards, their two kinds, and recorded instances."""

from __future__ import annotations

import abc
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from dcreg.problem import suggestion

SHA256 = r"^[0-9a-f]{64}$"
Dim = Literal[2, 3]


class DataError(Exception):
    """Something is wrong with a dataset; the message names file, value and remedy."""


class UnknownNameError(DataError, ValueError):
    """A shape, test, level or trial that the dataset does not have."""


class File(BaseModel):
    """One file of a dataset.

    ``path`` is its location in a mirror folder and, below the dataset's name, in the cache. ``url`` is
    its official origin at a pinned commit; None for a pack that exists in a mirror only (the loader then
    knows the original files).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    dataset: str = Field(default="", pattern=r"^[a-z0-9_]*$")  # filled in from the card
    path: str = Field(pattern=r"^[^/\x00][^\x00]*$")
    url: str | None = Field(default=None, pattern=r"^https?://")
    sha256: str | None = Field(default=None, pattern=SHA256)
    git_sha1: str | None = Field(default=None, pattern=r"^[0-9a-f]{40}$")  # git's blob id
    size: int | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _has_one_checksum(self) -> File:
        if (self.sha256 is None) == (self.git_sha1 is None):
            raise ValueError(f"{self.path}: give exactly one of sha256 and git_sha1")
        if ".." in Path(self.path).parts:
            raise ValueError(f"{self.path}: '..' is not allowed in a path")
        return self


class Card(BaseModel):
    """Validated ``card.yaml``: origin, licence and loader of the data."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    title: str = ""
    dim: Dim | dict[str, Dim]  # of all shapes, or per shape
    files: tuple[File, ...] = ()
    licence: str = "not stated"
    citation: str = "none"
    notes: str = ""
    loader: str  # a stock loader of data/loaders.py, or "own" for loader.py in the same folder
    parameters: dict[str, Any] = {}  # for the loader
    # Limits of the errors of a successful pose, which is below all that are given: RMSE of the true pairs
    # and translation error in the unit of the target, rotation error in degrees. If none is given, the
    # general rule applies: `workflows.metrics.errors.SUCCESS_SHARE`
    success_rmse: float | None = Field(default=None, gt=0)
    success_rotation_deg: float | None = Field(default=None, gt=0)
    success_translation: float | None = Field(default=None, gt=0)
    _path: Path | None = PrivateAttr(default=None)

    @model_validator(mode="before")
    @classmethod
    def _name_the_owner(cls, values: dict[str, Any]) -> dict[str, Any]:
        name, files = values.get("name", ""), values.get("files", [])
        if isinstance(files, list):
            files = [
                {"dataset": name, **file} if isinstance(file, dict) else file for file in files
            ]
        return {"title": name, **values, "files": files}

    @model_validator(mode="after")
    def _states_the_terms_of_files(self) -> Card:
        for term in ("licence", "citation") if self.files else ():
            if term not in self.model_fields_set:
                raise ValueError(f"{term}: missing; add it, as the files are third-party data")
        return self

    def placed(self, path: Path) -> Card:
        """Return the card with the path of its file."""
        self._path = path
        return self

    @property
    def path(self) -> Path:
        """The file of the card."""
        return self._path or Path(__file__).parent / self.name / "card.yaml"

    @property
    def folder(self) -> Path:
        """The folder of the dataset, to which relative paths refer."""
        return self.path.parent

    @property
    def success_limits(self) -> dict[str, float]:
        """Limits of the errors of a successful pose, by metric; empty: the general rule."""
        given = {
            "rmse": self.success_rmse,
            "rotation_error_deg": self.success_rotation_deg,
            "translation_error": self.success_translation,
        }
        return {name: limit for name, limit in given.items() if limit is not None}

    def file(self, path: str) -> File:
        """Return the file with this mirror path."""
        return next(file for file in self.files if file.path == path)


@dataclass(frozen=True)
class RawInstance:
    """A registration problem with its ground truth.

    Attributes
    ----------
    source : (n, d) array
    target : (m, d) array
    pairs : (k, 2) int array
        True pairs: ``source[pairs[:, 0]]`` belongs to ``target[pairs[:, 1]]``, one to one.
    T_true : (d+1, d+1) array
        Reference pose, homogeneous, ``target ≈ T_true @ [source, 1]`` at the true pairs: the fit to
        them (`data.sampling.reference_pose`), or the published one of a benchmark that has its own.
    scale_range : (low, high)
        Admissible scales, given to solvers; (1, 1) in 3D.
    info : dict
        Facts for display (overlap, ...), not used for solving or evaluation.
    noise_bound : float, optional
        Inlier distance of the benchmark's protocol; default: from the true pairs.
    match_radii : (of normals, of features), optional
        Radii of the FPFH features if all methods share matches.
    n_inliers : int, optional
        Number of pairs that the benchmark's protocol gives to methods; default: the true one.
    marks : ((k, d), (k, d)) arrays, optional
        Corresponding points of source and target for the evaluation, if they are not among the points to
        register; default: the true pairs.
    viewpoint : (3,) floats, optional
        Sensor position in the frame of each cloud, towards which the normals of the features of shared
        matches are oriented. None: no orientation.
    """

    source: np.ndarray
    target: np.ndarray
    pairs: np.ndarray
    T_true: np.ndarray
    scale_range: tuple[float, float]
    info: dict[str, float | str] = field(default_factory=dict)
    noise_bound: float | None = None
    match_radii: tuple[float, float] | None = None
    n_inliers: int | None = None
    marks: tuple[np.ndarray, np.ndarray] | None = None
    viewpoint: tuple[float, float, float] | None = None

    @property
    def judged(self) -> tuple[np.ndarray, np.ndarray]:
        """Corresponding points of source and target, row by row, for the evaluation."""
        if self.marks is not None:
            return self.marks
        return self.source[self.pairs[:, 0]], self.target[self.pairs[:, 1]]


@dataclass(frozen=True)
class Axis:
    """The levels of one test.

    ``levels`` name the levels in configs; ``values`` are what they stand for on a plot's axis
    (with ``label``), the same length.
    """

    levels: tuple[float, ...]
    values: tuple[float, ...]
    label: str
    n_trials: int


class Dataset(abc.ABC):
    """A card and named shapes; files are fetched when they are needed."""

    def __init__(self, card: Card) -> None:
        self.card = card

    @property
    def name(self) -> str:
        return self.card.name

    def dim(self, shape: str) -> Dim:
        """Return the dimension of the points of `shape`."""
        return self.card.dim[shape] if isinstance(self.card.dim, dict) else self.card.dim

    def model(self, shape: str) -> Literal["similarity2d", "rigid3d"]:
        """Return the transformation model of `shape`."""
        return "similarity2d" if self.dim(shape) == 2 else "rigid3d"

    @abc.abstractmethod
    def shapes(self) -> list[str]:
        """Return the names of the shapes (of scenes, for scans)."""

    @abc.abstractmethod
    def fetch(self, shape: str, test: str = "", level: float = 0.0, trial: int = 0) -> list[Path]:
        """Fetch the files that this instance (prototypes: this shape) needs; return their paths.

        The files are verified and in the cache. Loading calls this; a workflow may call it before, while
        there is a network.
        """

    def tests(self) -> dict[str, Axis]:
        """Return the recorded tests by name; empty for prototypes, to which disturbances are applied."""
        return {}

    def size_note(self, n_points: int | None) -> str:
        """Return how clouds are reduced to `n_points` of the config; empty if they are not."""
        return ""

    def local_files(self) -> list[Path]:
        """Return files outside the dataset's folder and the cache that determine its instances."""
        return []

    def has(self, shape: str, test: str, level: float, trial: int) -> bool:
        """Whether the instance exists; a grid of levels and trials may be incomplete."""
        return True

    def _known(self, what: str, value: Any, choices: Iterable[Any]) -> None:
        """Raise unless `value` is one of `choices`."""
        choices = list(choices)
        if value in choices:
            return
        if all(isinstance(choice, str) for choice in choices):
            hint = suggestion(str(value), choices)
        else:
            hint = f"; known: {f'{choices[0]}..{choices[-1]}' if len(choices) > 20 else choices}"
        raise UnknownNameError(f"dataset {self.name}: no {what} {value!r}{hint}")


class PrototypeDataset(Dataset):
    """Shapes that the disturbances of `workflows.disturb` turn into instances."""

    @abc.abstractmethod
    def points(self, shape: str, n_points: int | None = None) -> np.ndarray:
        """Return points of `shape` in its original coordinates."""

    def prototype(self, shape: str, n_points: int | None = None) -> np.ndarray:
        """Return the normalised shape: bounding box centred at 0, longest side 1.

        Parameters
        ----------
        shape : str
            One of `shapes()`.
        n_points : int, optional
            Number of points, by farthest-point sampling for data from files; default: all points of a
            2D shape, 100 points of a 3D shape.

        Returns
        -------
        (n_points, d) float64 array, identical in every call.
        """
        from data.sampling import normalise

        self._known("shape", shape, self.shapes())
        if n_points is not None and n_points < 3:
            raise DataError(f"dataset {self.name}: n_points={n_points}; use at least 3")
        return normalise(self.points(shape, n_points))


class RecordedDataset(Dataset):
    """Recorded instances: source and target from files, with known ground truth."""

    def takes_n_points(self, test: str) -> bool:
        """Whether the clouds of this test can be reduced to a given number of points."""
        return True

    @abc.abstractmethod
    def tests(self) -> dict[str, Axis]:
        """Return the recorded tests by name."""

    @abc.abstractmethod
    def files(self, shape: str, test: str, level: float, trial: int) -> list[Path]:
        """As `fetch`, with names already checked."""

    @abc.abstractmethod
    def load(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None
    ) -> RawInstance:
        """As `instance`, with names already checked."""

    def fetch(self, shape: str, test: str = "", level: float = 0.0, trial: int = 0) -> list[Path]:
        self._check(shape, test, level, trial)
        return self.files(shape, test, level, trial)

    def instance(
        self, shape: str, test: str, level: float, trial: int, n_points: int | None = None
    ) -> RawInstance:
        """Return one recorded instance, in the order of its files.

        Parameters
        ----------
        shape, test, level
            From `shapes()` and `tests()`.
        trial : int
            0 .. ``tests()[test].n_trials - 1``.
        n_points : int, optional
            Points per set for scans; sets of a fixed size accept None only.
        """
        self._check(shape, test, level, trial)
        return self.load(shape, test, level, trial, n_points)

    def _check(self, shape: str, test: str, level: float, trial: int) -> None:
        self._known("shape", shape, self.shapes())
        self._known("test", test, self.tests())
        axis = self.tests()[test]
        self._known(f"level of test {test}", level, axis.levels)
        self._known(f"trial of test {test}", trial, range(axis.n_trials))
        if not self.has(shape, test, level, trial):
            raise UnknownNameError(
                f"dataset {self.name}: {shape} has no trial {trial} of {test} {level:g}; use another"
            )
