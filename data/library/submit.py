"""Submissions: better poses and bounds from others, accepted only after a check.

A submission is a JSON file, valid under ``submission.schema.json``; docs/library.md shows one.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from data.library.evaluate import admissible, evaluate
from data.library.problem import (
    LibraryError,
    Matrix,
    Problem,
    changed_files,
    checksums,
    find_problem,
    validated,
)
from data.library.record import (
    LAST_DIGITS,
    PROOFS,
    RECORDS,
    BoundEntry,
    Date,
    PoseEntry,
    Proof,
    Record,
    own_command,
    read_record,
    write_record,
)
from dcreg.certificate.format import Certificate, CertificateError, read
from dcreg.certificate.verification import Report, verify

# Bytes of a proof file in the repository. A larger one must be stored unless `own_command` makes it
# again, because the command of another program cannot be run to check the bound.
MAX_OWN, MAX_OTHER = 600_000, 1_000_000
STATED = 1e-6  # relative error that a stated objective may have


class PoseClaim(BaseModel):
    """A pose and the objective that its author states."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    pose: Matrix
    objective: float = Field(ge=0.0)


class BoundClaim(BaseModel):
    """A lower bound and its certificate, relative to the submission."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    lower_bound: float = Field(gt=0.0)
    proof: str
    command: str = ""  # that makes the proof again


class Submission(BaseModel):
    """A better pose, a better bound, or both, for one problem."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["dcreg library submission"]
    problem: str
    by: str = Field(min_length=1)
    date: Date
    how: str = Field(min_length=1)
    better_pose: PoseClaim | None = None
    better_bound: BoundClaim | None = None


@dataclass
class Outcome:
    """What was accepted, and what was refused with the reason."""

    accepted: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def submit(path: Path, records: Path = RECORDS, proofs: Path = PROOFS) -> Outcome:
    """Check a submission and add what it improves to the record of its problem.

    Raises
    ------
    LibraryError
        If the file is not a submission, or its problem is unknown.
    DataError
        If the points of the problem cannot be fetched.
    """
    given: Submission = validated(Submission, path)
    if given.better_pose is None and given.better_bound is None:
        raise LibraryError(f"{path}: better_pose, better_bound: give at least one of them")
    problem = find_problem(given.problem)
    if faults := changed_files(checksums()):
        raise LibraryError(faults[0])  # a claim about it would say nothing about the problem
    record, outcome = read_record(problem.id, records), Outcome()
    if given.better_pose is not None:
        record = _with_pose(problem, record, given, given.better_pose, outcome)
    if given.better_bound is not None:
        proof = path.parent / given.better_bound.proof
        record = _with_bound(problem, record, given, proof, proofs, outcome)
    if outcome.accepted:
        write_record(record, records)
    return outcome


def _with_pose(
    problem: Problem, record: Record, given: Submission, claim: PoseClaim, outcome: Outcome
) -> Record:
    try:
        pose = admissible(problem, claim.pose)
        value = evaluate(problem, pose)
        if abs(value - claim.objective) > STATED * max(value, claim.objective):
            raise LibraryError(
                f"{problem.id}: objective: {claim.objective:.9g} stated, but the pose has {value:.9g}"
            )
        if value < record.lower_bound * (1 - LAST_DIGITS):
            raise LibraryError(
                f"{problem.id}: objective: {value:.9g} is below the proven bound "
                f"{record.lower_bound:.9g}; report this contradiction"
            )
        if value >= record.objective * (1 - LAST_DIGITS):
            raise LibraryError(
                f"{problem.id}: objective: {value:.12g} is not below the best known one, "
                f"{record.objective:.12g}"
            )
    except LibraryError as error:
        outcome.refused.append(str(error))
        return record
    outcome.accepted.append(f"{problem.id}: pose with objective {value:.12g}")
    entry = PoseEntry(
        by=given.by, date=given.date, how=given.how, objective=value, pose=pose.tolist()
    )
    return record.with_entries(entry)


def _with_bound(
    problem: Problem, record: Record, given: Submission, proof: Path, proofs: Path, outcome: Outcome
) -> Record:
    claim = given.better_bound
    assert claim is not None
    try:
        certificate, report = checked_proof(problem, proof)
        if report.lower_bound < claim.lower_bound * (1 - LAST_DIGITS):
            raise LibraryError(
                f"{problem.id}: lower_bound: {claim.lower_bound:.9g} stated, but the proof gives "
                f"{report.lower_bound:.9g}"
            )
        if claim.lower_bound <= record.lower_bound * (1 + LAST_DIGITS):
            raise LibraryError(
                f"{problem.id}: lower_bound: {claim.lower_bound:.9g} is not above the best proven one, "
                f"{record.lower_bound:.9g}"
            )
        if claim.lower_bound > record.objective * (1 + LAST_DIGITS):
            raise LibraryError(
                f"{problem.id}: lower_bound: {claim.lower_bound:.9g} exceeds the objective "
                f"{record.objective:.9g} of a known pose; report this contradiction"
            )
        stored = stored_proof(problem, proof, certificate, report.time_s, claim.command, proofs)
    except LibraryError as error:
        outcome.refused.append(str(error))
        return record
    outcome.accepted.append(f"{problem.id}: lower bound {claim.lower_bound:.12g}")
    entry = BoundEntry(
        by=given.by, date=given.date, how=given.how, lower_bound=claim.lower_bound, proof=stored
    )
    return record.with_entries(entry)


def checked_proof(problem: Problem, path: Path) -> tuple[Certificate, Report]:
    """Read a certificate of this problem and let the independent checker prove its bound.

    Raises
    ------
    LibraryError
        If it states another problem, or if the checker rejects it.
    """
    try:
        certificate = read(path)
    except CertificateError as error:
        raise LibraryError(f"{problem.id}: proof: {error}") from None
    stated = (certificate.model, certificate.n_inliers, tuple(map(float, certificate.scale_range)))
    wanted = (problem.model, problem.n_inliers, problem.scale_range)
    if stated != wanted or len(certificate.candidates):
        raise LibraryError(
            f"{problem.id}: proof: its model, n_inliers and scale_range are {stated}"
            f"{' with candidates' if len(certificate.candidates) else ''}, the problem has {wanted}; "
            "certify the problem"
        )
    report = verify(certificate, *problem.clouds)
    if not report.accepted:
        raise LibraryError(f"{problem.id}: proof: the checker rejects it: {report.reason}")
    return certificate, report


def proof_path(problem_id: str, sha256: str, folder: Path = PROOFS) -> Path:
    """Return the path of a stored proof; the digest distinguishes proofs of one problem."""
    return folder / f"{problem_id}.{sha256[:8]}.npz"


def stored_proof(
    problem: Problem,
    path: Path,
    certificate: Certificate,
    check_s: float,
    command: str,
    folder: Path,
) -> Proof:
    """Store a proof that was checked, if it is small enough, and return its description.

    Raises
    ------
    LibraryError
        If it is too large and this project cannot make it.
    """
    content, own = path.read_bytes(), own_command(problem.id)
    sha256 = hashlib.sha256(content).hexdigest()
    is_stored = len(content) <= (MAX_OWN if command == own else MAX_OTHER)
    if is_stored:
        folder.mkdir(parents=True, exist_ok=True)
        proof_path(problem.id, sha256, folder).write_bytes(content)  # `path` may be this file
    elif command != own:
        raise LibraryError(
            f"{problem.id}: proof: {len(content):,} bytes exceed {MAX_OTHER:,}, and its command is not "
            f"`{own}`, the only one that a check can run; give a smaller proof"
        )
    return Proof(
        sha256=sha256, size=len(content), n_leaves=len(certificate.leaf_bounds), stored=is_stored,
        command=command, check_s=round(check_s, 3),
    )  # fmt: skip
