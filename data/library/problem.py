"""The problems of the library, and their files. A file is never changed; a correction has a new version.

``problems/NAME@VERSION.json`` is valid under ``problem.schema.json``, which
``python -m data.library schema`` writes from the classes of this module. Numbers have enough digits to
give the same doubles when they are read.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from collections.abc import Iterable
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from data.contract import SHA256, DataError
from data.library.recipe import Recipe
from dcreg.certificate.format import digest
from dcreg.files import write_text

HERE = Path(__file__).parent
PROBLEMS = HERE / "problems"
CHECKSUMS = HERE / "checksums.json"
FAMILIES = (
    "paper", "public", "symmetry", "repetition", "near-tie", "decoy", "overlap", "tiny",
)  # fmt: skip

Matrix = list[list[float]]
_NAME = r"[a-z][a-z0-9-]*"
Name = Annotated[str, Field(pattern=f"^{_NAME}$", max_length=60)]


class LibraryError(DataError, ValueError):
    """A problem, a record or a submission is invalid; the message names the field."""


class Truth(BaseModel):
    """The true pairs and the pose fitted to them. The pose need not be optimal."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pose: Matrix  # homogeneous; the fit to the pairs
    pairs: list[tuple[int, int]]  # source row, target row


class Problem(BaseModel):
    """Minimise the sum of squared residuals of `n_inliers` one-to-one pairs over all poses of a model."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["dcreg library problem"] = "dcreg library problem"
    format_version: Literal[1] = 1
    name: Name
    version: int = Field(ge=1)
    family: Literal[FAMILIES]  # type: ignore[valid-type]
    title: str
    origin: str
    licence: str
    unit: str
    model: Literal["similarity2d", "rigid3d"]
    n_inliers: int = Field(ge=1)
    scale_range: tuple[float, float]
    n_source: int = Field(ge=1)
    n_target: int = Field(ge=1)
    source_sha256: str = Field(pattern=SHA256)
    target_sha256: str = Field(pattern=SHA256)
    planted_optima: int | None = Field(default=None, ge=1)
    truth: Truth | None = None
    recipe: Recipe | None = None  # instead of points that must not be part of the library
    source_points: Matrix | None = Field(default=None, alias="source")
    target_points: Matrix | None = Field(default=None, alias="target")

    @model_validator(mode="after")
    def _has_points(self) -> Problem:
        given = (self.source_points is not None, self.target_points is not None)
        if given != (self.recipe is None,) * 2:
            raise ValueError(f"{self.id}: give source and target, or a recipe")
        return self

    @property
    def id(self) -> str:
        return f"{self.name}@{self.version}"

    @property
    def dim(self) -> int:
        return 2 if self.model == "similarity2d" else 3

    @property
    def overlap(self) -> float:
        """True pairs, or `n_inliers` if they are unknown, as a share of the larger cloud."""
        n_pairs = self.n_inliers if self.truth is None else len(self.truth.pairs)
        return n_pairs / max(self.n_source, self.n_target)

    @cached_property
    def clouds(self) -> tuple[np.ndarray, np.ndarray]:
        """Source and target; the points of a recipe are fetched and compared with the checksums.

        Raises
        ------
        LibraryError
            If the points differ from the checksums.
        DataError
            If the files of a recipe cannot be fetched.
        """
        if self.recipe is None:
            source, target = np.array(self.source_points), np.array(self.target_points)
        else:
            source, target = self.recipe.clouds()
        for role, points, stated in (
            ("source", source, self.source_sha256), ("target", target, self.target_sha256),
        ):  # fmt: skip
            if (found := digest(points)) != stated:
                raise LibraryError(
                    f"{self.id}: {role} has the checksum {found[:12]}…, not {stated[:12]}…; restore "
                    "the file, or give the changed problem a new version"
                )
        return source, target

    @property
    def needs_files(self) -> bool:
        """Whether the points are not part of the library."""
        return self.recipe is not None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of `dcreg.register` that state the problem."""
        scales = {"scale_range": self.scale_range} if self.dim == 2 else {}
        return {"model": self.model, "n_inliers": self.n_inliers, **scales}

    def text(self) -> str:
        """Return the content of the file: JSON with one point per line."""
        content = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        lines = []
        for key, value in content.items():
            if key in ("source", "target"):
                rows = ",\n".join(json.dumps(row, separators=(",", ":")) for row in value)
                lines.append(f"{json.dumps(key)}: [\n{rows}\n]")
            else:
                lines.append(f"{json.dumps(key)}: {json.dumps(value, separators=(',', ':'))}")
        return "{\n" + ",\n".join(lines) + "\n}\n"


def problem_path(problem_id: str, folder: Path = PROBLEMS) -> Path:
    return folder / f"{problem_id}.json"


def write_problem(problem: Problem, folder: Path = PROBLEMS) -> Path:
    """Write a new problem; refuse to change an existing one.

    Raises
    ------
    LibraryError
        If the library has a different problem of this name and version.
    """
    path, text = problem_path(problem.id, folder), problem.text()
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise LibraryError(
            f"{path}: differs from the new content; problems never change, so use version "
            f"{problem.version + 1}"
        )
    write_text(path, text)
    return path


def read_problem(path: Path) -> Problem:
    """Read and validate one file.

    Raises
    ------
    LibraryError
    """
    problem: Problem = validated(Problem, path)
    if problem.id != path.stem:
        raise LibraryError(f"{path}: name and version give {problem.id}; rename the file")
    return problem


def validated(kind: type[Any], path: Path) -> Any:
    """Read a JSON file as an object of a pydantic class.

    Raises
    ------
    LibraryError
        If the file is missing or invalid.
    """
    try:
        return kind.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LibraryError(f"{path}: no such file; see `python -m data.library list`") from None
    except OSError as error:
        raise LibraryError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise LibraryError(f"{path}: not a text file in UTF-8; give a JSON file") from None
    except ValidationError as error:
        wrong = error.errors()[0]
        field = ".".join(map(str, wrong["loc"])) or "content"
        raise LibraryError(f"{path}: {field}: {wrong['msg']}; see docs/library.md") from None


@cache
def all_problems() -> dict[str, Problem]:
    """Return the newest version of every problem, by ``NAME@VERSION``."""
    found = [read_problem(path) for path in PROBLEMS.glob("*.json")]
    return {problem.id: problem for problem in newest(found)}


def newest(problems: Iterable[Problem]) -> list[Problem]:
    """Return the newest version of each name, sorted by name."""
    last: dict[str, Problem] = {}
    for problem in sorted(problems, key=lambda problem: problem.version):
        last[problem.name] = problem
    return [last[name] for name in sorted(last)]


def find_problem(problem_id: str) -> Problem:
    """Return the problem ``NAME`` (the newest version) or ``NAME@VERSION``.

    Raises
    ------
    LibraryError
        If there is none.
    """
    known = all_problems()
    if "@" not in problem_id:
        problem_id = next((key for key in known if key.startswith(f"{problem_id}@")), problem_id)
    if problem_id in known:
        return known[problem_id]
    is_name = re.fullmatch(rf"{_NAME}@[0-9]+", problem_id)  # not a path to another file
    if is_name and problem_path(problem_id).is_file():  # an older version
        return read_problem(problem_path(problem_id))
    similar = difflib.get_close_matches(problem_id, known, n=5, cutoff=0.5)
    hint = f"; similar: {', '.join(similar)}" if similar else ""
    raise LibraryError(
        f"no problem {problem_id!r}{hint}; `python -m data.library list` prints all names"
    )


def checksums() -> dict[str, str]:
    """Return the SHA-256 of every problem file, by ``NAME@VERSION``."""
    return {
        path.stem: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(PROBLEMS.glob("*.json"))
    }


def changed_files(found: dict[str, str]) -> list[str]:
    """Return a line for each listed problem file that differs from the list, or is missing."""
    listed = json.loads(CHECKSUMS.read_text(encoding="utf-8")) if CHECKSUMS.is_file() else {}
    return [
        f"{problem_id}: its file is {'missing' if problem_id not in found else 'changed'}; restore it, "
        "and give a corrected problem a new version"
        for problem_id, sha256 in listed.items()
        if found.get(problem_id) != sha256
    ]
