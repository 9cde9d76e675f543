"""Add the answers of `workflows.library.solve` to the records of the library."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypedDict

import numpy as np

import dcreg
from data.library.evaluate import admissible, evaluate
from data.library.matchings import best_of_all_matchings
from data.library.problem import Problem
from data.library.record import (
    LAST_DIGITS,
    PROOFS,
    RECORDS,
    BoundEntry,
    Enumeration,
    OptimaEntry,
    PoseEntry,
    Record,
    SolveEntry,
    own_command,
    read_record,
    write_record,
)
from data.library.submit import stored_proof
from dcreg.assignment.descent import polish
from workflows.library.solve import ANSWERS, Answer, read_answer


class Author(TypedDict):
    """Who found something, when and how."""

    by: str
    date: str
    how: str


HOW = {
    "default": "dcreg.register",
    "proof": "dcreg.register with a certificate",
}  # by kind of answer
BETTER = 1e-7  # relative; smaller improvements are rounding


def record_answers(
    problems: Iterable[Problem],
    answers: Path = ANSWERS,
    records: Path = RECORDS,
    proofs: Path = PROOFS,
) -> Iterator[str]:
    """Add what is new to the records; yield a line for each record that changed."""
    for problem in problems:
        old = read_record(problem.id, records)
        given = {
            how: read_answer(answers / f"{problem.id}.{kind}.json") for kind, how in HOW.items()
        }
        found = {how: answer for how, answer in given.items() if answer is not None}
        new = _with_poses(problem, old, found)
        for answer in found.values():
            new = _with_solve(new, answer)
            new = _with_bound(problem, new, answer, answers, proofs)
        new = _with_optima(problem, new)
        if new is not old:
            write_record(new, records)
            yield f"{problem.id}: {new.status(problem)}, gap {new.gap:.2%}"


def _with_poses(problem: Problem, record: Record, answers: dict[str, Answer]) -> Record:
    """Add the best of the poses found, and of the local search from the true pose."""
    found = [
        (np.array(answer.pose), how, answer.date, f"dcreg {answer.version}")
        for how, answer in answers.items()
    ]
    if not found:
        return record
    *_, date, by = found[0]
    if problem.truth is not None:
        source, target = problem.clouds
        stated = dcreg.Problem(source, target, **problem.keywords())
        pose, *_ = polish(stated, np.array(problem.truth.pose))
        found.append((pose, "local search from the true pose", date, by))
    for given, how, date, by in found:
        record = _with_better_pose(problem, record, given, {"by": by, "date": date, "how": how})
    return record


def _with_better_pose(
    problem: Problem, record: Record, given: np.ndarray, author: Author
) -> Record:
    """Add a pose, unless the best known one is as good."""
    pose = admissible(problem, given)
    value = evaluate(problem, pose)
    if value >= record.objective * (1 - BETTER):
        return record
    return record.with_entries(PoseEntry(**author, objective=value, pose=pose.tolist()))


def _with_solve(record: Record, answer: Answer) -> Record:
    """Add a solve, unless the same version and options already did as well."""
    by = f"dcreg {answer.version}"
    done = [entry for entry in record.solves if (entry.by, entry.options) == (by, answer.options)]
    if any(entry.status == "optimal" for entry in done):
        return record
    is_longer = all(entry.cpu_s < round(answer.cpu_s, 3) for entry in done)
    if answer.status != "optimal" and not is_longer:
        return record
    return record.with_entries(
        SolveEntry(
            by=by, date=answer.date, how="workflows.library solve", options=answer.options,
            status=answer.status, cpu_s=round(answer.cpu_s, 3),
        )
    )  # fmt: skip


def _with_bound(
    problem: Problem, record: Record, answer: Answer, answers: Path, proofs: Path
) -> Record:
    """Add a bound that the checker has proven, if it is better."""
    bound = answer.checked_bound
    if not bound or bound <= record.lower_bound * (1 + LAST_DIGITS):
        return record
    path = answers / f"{problem.id}.npz"
    proof = stored_proof(
        problem, path, dcreg.certificate.read(path), answer.check_s or 0.0,
        own_command(problem.id), proofs,
    )  # fmt: skip
    how = "dcreg.register with a certificate, and dcreg.verify"
    return record.with_entries(
        BoundEntry(
            by=f"dcreg {answer.version}", date=answer.date, how=how, lower_bound=bound, proof=proof
        )
    )


def _with_optima(problem: Problem, record: Record) -> Record:
    """Add the number of optima, if all matchings can be tried or the construction states it.

    Trying all matchings also proves the bound of a tiny problem whose search did not end.
    """
    if record.optima is not None or record.best_pose is None:
        return record
    by, date = f"dcreg {dcreg.__version__}", record.best_pose.date
    if problem.family == "tiny":
        found = best_of_all_matchings(problem)
        author: Author = {"by": by, "date": date, "how": "all matchings were tried"}
        record = _with_better_pose(problem, record, found.pose, author)
        if not record.is_proven(problem):
            proof = Enumeration(n_matchings=found.n_matchings)
            bound = found.optimum * (1 - LAST_DIGITS)
            record = record.with_entries(BoundEntry(**author, lower_bound=bound, proof=proof))
        return record.with_entries(OptimaEntry(**author, count=found.n_optima))
    if problem.planted_optima and record.is_proven(problem):
        author = {"by": by, "date": date, "how": "by the symmetries of the construction"}
        return record.with_entries(OptimaEntry(**author, count=problem.planted_optima))
    return record
