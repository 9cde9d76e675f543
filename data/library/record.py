"""What is known about a problem: poses, bounds and solves, each with its author. Entries are only added.

``records/NAME@VERSION.json`` is valid under ``record.schema.json``.
"""

from __future__ import annotations

import json
import re
from datetime import date as calendar_date
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from data.contract import SHA256
from data.library.problem import HERE, Matrix, Problem, validated
from dcreg.files import write_text
from dcreg.names import DEFAULT_REL_GAP
from dcreg.problem import exact_objective

RECORDS = HERE / "records"
PROOFS = HERE / "proofs"
EASY_CPU_S = 60.0
LAST_DIGITS = 1e-9  # relative difference of two sums of the same squares

Status = Literal["easy", "hard", "open"]


def _existing(text: str) -> str:
    calendar_date.fromisoformat(text)  # pydantic reports its ValueError
    return text


Date = Annotated[
    str,
    Field(
        pattern=r"^\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])$",
        json_schema_extra={"format": "date"},
    ),
    AfterValidator(_existing),
]


def own_command(problem_id: str) -> str:
    """Return the command of this project that makes the proof of a problem."""
    return f"python -m workflows.library prove {problem_id} proof.npz"


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    by: str = Field(min_length=1)  # program and version, or person
    date: Date
    how: str = Field(min_length=1)


class PoseEntry(_Entry):
    """A pose with its objective, which two evaluators confirm."""

    kind: Literal["pose"] = "pose"
    objective: float = Field(ge=0.0)
    pose: Matrix


class Proof(BaseModel):
    """A certificate file: stored in ``proofs/``, or made again by `own_command`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["certificate"] = "certificate"
    sha256: str = Field(pattern=SHA256)
    size: int = Field(gt=0)
    n_leaves: int = Field(gt=0)
    stored: bool
    command: str = ""
    check_s: float = Field(ge=0.0)  # wall time of the check when it was accepted


class Enumeration(BaseModel):
    """All matchings of a tiny problem, each with its best pose in closed form."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["enumeration"] = "enumeration"
    n_matchings: int = Field(gt=0)


class BoundEntry(_Entry):
    """A lower bound that the independent checker has proven, or that all matchings give."""

    kind: Literal["bound"] = "bound"
    lower_bound: float = Field(gt=0.0)
    proof: Proof | Enumeration = Field(discriminator="kind")


class SolveEntry(_Entry):
    """One solve by `dcreg.register`, with its CPU time."""

    kind: Literal["solve"] = "solve"
    options: dict[str, Any]  # of dcreg.SolveOptions; empty: the defaults
    status: str
    cpu_s: float = Field(ge=0.0)


class OptimaEntry(_Entry):
    """The number of distinct poses with the minimum objective."""

    kind: Literal["optima"] = "optima"
    count: int = Field(ge=1)


Entry = Annotated[PoseEntry | BoundEntry | SolveEntry | OptimaEntry, Field(discriminator="kind")]


class Record(BaseModel):
    """All entries of one problem, the oldest first."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["dcreg library record"] = "dcreg library record"
    format_version: Literal[1] = 1
    problem: str
    entries: list[Entry] = []

    @property
    def poses(self) -> list[PoseEntry]:
        return [entry for entry in self.entries if isinstance(entry, PoseEntry)]

    @property
    def bounds(self) -> list[BoundEntry]:
        return [entry for entry in self.entries if isinstance(entry, BoundEntry)]

    @property
    def solves(self) -> list[SolveEntry]:
        return [entry for entry in self.entries if isinstance(entry, SolveEntry)]

    @property
    def best_pose(self) -> PoseEntry | None:
        return min(self.poses, key=lambda entry: entry.objective, default=None)

    @property
    def best_bound(self) -> BoundEntry | None:
        return max(self.bounds, key=lambda entry: entry.lower_bound, default=None)

    @property
    def objective(self) -> float:
        """Best known objective; infinite if there is no pose."""
        return float("inf") if self.best_pose is None else self.best_pose.objective

    @property
    def lower_bound(self) -> float:
        """Best proven lower bound; 0 holds for every problem."""
        return 0.0 if self.best_bound is None else self.best_bound.lower_bound

    @property
    def gap(self) -> float:
        """Relative gap, as a share of the best known objective."""
        upper = self.objective
        return 1.0 if upper == float("inf") else (upper - self.lower_bound) / (upper or 1.0)

    @property
    def optima(self) -> OptimaEntry | None:
        """The last statement on the number of optima."""
        return next((e for e in reversed(self.entries) if isinstance(e, OptimaEntry)), None)

    @property
    def certificate(self) -> Proof | None:
        """The certificate of the best bound; None without a bound, or if all matchings prove it."""
        proof = None if self.best_bound is None else self.best_bound.proof
        return proof if isinstance(proof, Proof) else None

    def is_proven(self, problem: Problem) -> bool:
        """Whether the gap is at most the default tolerance of `dcreg.register`, or the fit is exact."""
        if self.lower_bound > 0.0 and self.gap <= DEFAULT_REL_GAP * (1 + LAST_DIGITS):
            return True
        if problem.needs_files or self.best_pose is None:
            return False
        return self.objective <= exact_objective(*problem.clouds, problem.n_inliers)

    def easy_solve(self) -> SolveEntry | None:
        """Return a solve by dcreg with default options that took at most 60 s, if there is one."""
        for solve in self.solves:
            is_default = re.fullmatch(r"dcreg \d[\w.+]*", solve.by) and not solve.options
            if is_default and solve.status == "optimal" and solve.cpu_s <= EASY_CPU_S:
                return solve
        return None

    @property
    def tried_s(self) -> float:
        """CPU time of the longest recorded solve."""
        return max((solve.cpu_s for solve in self.solves), default=0.0)

    def status(self, problem: Problem) -> Status:
        """Return easy (proven by default options within 60 s), hard (proven otherwise) or open."""
        if not self.is_proven(problem):
            return "open"
        return "easy" if self.easy_solve() else "hard"

    def with_entries(self, *entries: Any) -> Record:
        """Return a record with more entries."""
        return self.model_copy(update={"entries": [*self.entries, *entries]})

    def text(self) -> str:
        """Return the content of the file: JSON with one entry per line."""
        rows = [entry.model_dump(mode="json") for entry in self.entries]
        lines = ",\n".join(json.dumps(row, separators=(",", ":")) for row in rows)
        head = f'"format": {json.dumps(self.format)},\n"format_version": {self.format_version},\n'
        return f'{{\n{head}"problem": {json.dumps(self.problem)},\n"entries": [\n{lines}\n]\n}}\n'


def record_path(problem_id: str, folder: Path = RECORDS) -> Path:
    return folder / f"{problem_id}.json"


def read_record(problem_id: str, folder: Path = RECORDS) -> Record:
    """Read the record of a problem; an empty one if the file does not exist.

    Raises
    ------
    LibraryError
        If the file is not valid.
    """
    path = record_path(problem_id, folder)
    if not path.is_file():
        return Record(problem=problem_id)
    record: Record = validated(Record, path)
    return record


def write_record(record: Record, folder: Path = RECORDS) -> Path:
    """Write a record and return its path."""
    path = record_path(record.problem, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, record.text())
    return path
