"""Check the library: files, poses by two evaluators, and proofs by the independent checker."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from data.contract import DataError
from data.library.evaluate import admissible, evaluate
from data.library.matchings import best_of_all_matchings
from data.library.problem import (
    CHECKSUMS,
    LibraryError,
    Problem,
    changed_files,
    checksums,
    problem_path,
    read_problem,
)
from data.library.record import LAST_DIGITS, PROOFS, Enumeration, Record, own_command, read_record
from data.library.submit import checked_proof, proof_path
from dcreg.files import write_text

SAMPLE_EVERY = 4  # of the stored proofs, in the order of their names
QUICK_CHECK_S = 5.0  # time for a proof of the sample, at most

Say = Callable[[str], None]


@dataclass
class Checked:
    """What was checked and skipped, and the faults found."""

    n_problems: int = 0
    n_poses: int = 0
    n_bounds: int = 0
    n_proofs: int = 0  # of bounds, that were verified
    n_not_stored: int = 0
    no_data: list[str] = field(default_factory=list)  # problems, with the reason
    faults: list[str] = field(default_factory=list)


def write_checksums() -> Path:
    """Add the checksums of new problem files to the list.

    Raises
    ------
    LibraryError
        If a listed file has changed or is missing.
    """
    found = checksums()
    if faults := changed_files(found):
        raise LibraryError(faults[0])
    write_text(CHECKSUMS, json.dumps(found, indent=0) + "\n")
    return CHECKSUMS


def check(say: Say, *, every_proof: bool = False) -> Checked:
    """Check all problems and records, and a sample of the proofs, or every proof."""
    done, found = Checked(), checksums()
    done.faults += changed_files(found)
    sample = set(sampled_proofs(found)) if not every_proof else set(found)
    for problem_id in found:
        try:
            problem = read_problem(problem_path(problem_id))
            record = read_record(problem_id)
            wrong = faulty_description(problem, record)
            done.faults += wrong
            _ = problem.clouds
        except LibraryError as error:
            done.faults.append(str(error))
            continue
        except DataError as error:  # the files of a recipe
            done.no_data.append(f"{problem_id}: {error}")
            continue
        done.n_problems += 1
        done.faults += faulty_poses(problem, record)
        done.n_poses += len(record.poses)
        done.n_bounds += record.best_bound is not None
        if record.certificate is not None and not record.certificate.stored:
            done.n_not_stored += 1
        elif record.best_bound is not None and problem_id in sample and not wrong:
            done.n_proofs += 1
            done.faults += faulty_proof(problem, record)
            say(f"{problem_id}: proof of {record.lower_bound:.9g}")
    return done


def sampled_proofs(problem_ids: Iterable[str]) -> list[str]:
    """Return the problems whose proof every check verifies: each fourth of the quick stored ones."""
    quick = []
    for problem_id in sorted(problem_ids):
        proof = read_record(problem_id).certificate
        if proof is not None and proof.stored and proof.check_s <= QUICK_CHECK_S:
            quick.append(problem_id)
    return quick[::SAMPLE_EVERY]


def faulty_poses(problem: Problem, record: Record) -> list[str]:
    """Evaluate all poses of a record again; return what is wrong."""
    faults = []
    for entry in record.poses:
        try:
            value = evaluate(problem, admissible(problem, entry.pose))
        except LibraryError as error:
            faults.append(str(error))
            continue
        if abs(value - entry.objective) > LAST_DIGITS * max(value, entry.objective):
            faults.append(
                f"{problem.id}: objective: {entry.objective!r} is stored, but the pose of {entry.by} "
                f"has {value!r}"
            )
    if record.lower_bound > record.objective * (1 + LAST_DIGITS):
        faults.append(f"{problem.id}: lower_bound: {record.lower_bound!r} exceeds the objective")
    return faults


def faulty_description(problem: Problem, record: Record, proofs: Path = PROOFS) -> list[str]:
    """Return what is wrong with the description of the best bound's proof, without verifying it.

    The stored file must be the accepted one. Without a file, this project must be able to make the proof.
    """
    bound = record.best_bound
    if bound is None:
        return []
    proof, fault = bound.proof, ""
    if isinstance(proof, Enumeration):
        if problem.family != "tiny":
            fault = "all matchings can be tried for tiny problems only"
    elif not proof.stored:
        if proof.command != (own := own_command(problem.id)):
            fault = f"its command is {proof.command!r}, not {own!r}"
    else:
        path = proof_path(problem.id, proof.sha256, proofs)
        if not path.is_file():
            fault = f"{path.name}: no such file; restore it"
        elif hashlib.sha256(path.read_bytes()).hexdigest() != proof.sha256:
            fault = f"{path.name} is not the file that was accepted; restore it"
    return [f"{problem.id}: proof: {fault}"] if fault else []


def faulty_proof(problem: Problem, record: Record, proofs: Path = PROOFS) -> list[str]:
    """Verify the stored proof of the best bound again; return what is wrong."""
    bound = record.best_bound
    assert bound is not None
    if wrong := faulty_description(problem, record, proofs):
        return wrong
    if isinstance(bound.proof, Enumeration):
        proven = best_of_all_matchings(problem).optimum
    else:
        try:
            path = proof_path(problem.id, bound.proof.sha256, proofs)
            proven = checked_proof(problem, path)[1].lower_bound
        except LibraryError as error:
            return [str(error)]
    if proven < bound.lower_bound * (1 - LAST_DIGITS):
        return [
            f"{problem.id}: lower_bound: {bound.lower_bound!r} is stored, but the proof gives {proven!r}"
        ]
    return []
