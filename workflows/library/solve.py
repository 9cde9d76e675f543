"""Solve the problems with the library: ``python -m workflows.library solve``.

Each problem is solved with default options, then with a certificate, which the independent checker
verifies. The answers are kept in ``results/library``. A repeated command skips the problems that are
proven, or that already had as much CPU time as is now allowed.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import dcreg
from data.contract import DataError
from data.library.check import faulty_description
from data.library.problem import LibraryError, Problem
from data.library.record import LAST_DIGITS, read_record
from data.library.submit import checked_proof
from dcreg.files import as_json, write_text
from dcreg.names import DEFAULT_REL_GAP
from dcreg.status import Status

ANSWERS = Path("results") / "library"
PROVE = {"certificate": True, "prove": True}  # options of a solve that keeps its proof
# CPU time to check a proof of the optimum; a weaker bound gets twice the time of a solve.
CHECK_S = 600.0
EARLY_S = 10.0  # after which a check that is expected to take longer is given up
WALL_PER_CPU = 8.0  # wall time per CPU time, at most, on a busy machine


@dataclass(frozen=True)
class Answer:
    """One solve: what was found, with which options, and in how much CPU time.

    Attributes
    ----------
    options : dict
        Arguments of `dcreg.SolveOptions`; none for the default.
    status : str
    pose : list
    objective : float
    lower_bound : float
    cpu_s, limit_s : float
        CPU time taken and allowed.
    scope : str
        What the bounds refer to.
    checked_bound : float, optional
        Lower bound that the independent checker proved.
    check_s : float, optional
        CPU time of the check.
    reason : str
        Why the checker did not accept the proof.
    version : str
        Of dcreg.
    date : str
    """

    options: dict[str, Any]
    status: str
    pose: list[list[float]]
    objective: float
    lower_bound: float
    cpu_s: float
    limit_s: float
    scope: str
    checked_bound: float | None = None
    check_s: float | None = None
    reason: str = ""
    version: str = dcreg.__version__
    date: str = field(default_factory=lambda: time.strftime("%Y-%m-%d"))


class _OutOfTimeError(Exception):
    pass


def solve_all(problems: Iterable[Problem], limit_s: float, folder: Path = ANSWERS) -> None:
    """Solve all problems that need it, and print a line for each."""
    for problem in problems:
        began = time.process_time()
        if answers := solve(problem, limit_s, folder):
            words = [
                f"{'default' if not answer.options else 'proof'} {answer.status} {answer.cpu_s:.1f} s"
                for answer in answers
            ]
            if answers[-1].options:
                words.append(f"checked {answers[-1].checked_bound} {answers[-1].reason}")
            print(
                f"{problem.id}: {'; '.join(words)}; {time.process_time() - began:.1f} s", flush=True
            )


def solve(problem: Problem, limit_s: float, folder: Path = ANSWERS) -> list[Answer]:
    """Solve one problem, unless it is proven or had as much time; return the new answers."""
    new = []
    default = read_answer(folder / f"{problem.id}.default.json")
    if default is None or (not _is_proven(default) and default.limit_s < limit_s):
        default, _ = _timed(problem, {}, limit_s)
        _keep(default, folder / f"{problem.id}.default.json")
        new.append(default)
    proof = read_answer(folder / f"{problem.id}.proof.json")
    if proof is None or (not proof.checked_bound and proof.limit_s < limit_s):
        path = folder / f"{problem.id}.npz"
        if proof is None or not _is_proven(proof):
            proof, certificate = _timed(problem, PROVE, limit_s)
            assert certificate is not None
            dcreg.certificate.write(path, certificate)
        proof = replace(proof, limit_s=limit_s)
        if proof.lower_bound > 0.0:
            proof = _checked(problem, proof, path, limit_s)
        _keep(proof, folder / f"{problem.id}.proof.json")
        new.append(proof)
    return new


def prove(problem: Problem, out: Path, limit_s: float, rel_gap: float = DEFAULT_REL_GAP) -> str:
    """Write a certificate of a problem and return a sentence about it."""
    answer, certificate = _timed(problem, PROVE, limit_s, rel_gap)
    assert certificate is not None
    dcreg.certificate.write(out, certificate)
    return (
        f"{out}: {answer.status}, lower bound {answer.lower_bound:.9g}, {answer.cpu_s:.1f} s of CPU"
    )


def reprove(problems: Iterable[Problem], limit_s: float) -> Iterator[tuple[str, bool]]:
    """Make and check again the proofs that are not stored; yield a line and whether the bound holds.

    The new proof is another file in general, because a search is not reproducible bit by bit on every
    machine. The checker must prove at least the recorded bound from it.
    """
    for problem in problems:
        record = read_record(problem.id)
        if record.certificate is None or record.certificate.stored:
            continue
        if faults := faulty_description(problem, record):
            yield faults[0], False
            continue
        try:
            with TemporaryDirectory() as folder:
                path = Path(folder) / "proof.npz"
                # a search may end with a smaller bound that is within its gap too
                prove(problem, path, limit_s, max(record.gap, LAST_DIGITS))
                proven = checked_proof(problem, path)[1].lower_bound
        except LibraryError as error:
            yield str(error), False
            continue
        except DataError as error:
            yield f"skipped: {problem.id}: data not available: {error}", True
            continue
        line = f"{problem.id}: recorded {record.lower_bound:.9g}, proven again {proven:.9g}"
        yield line, proven >= record.lower_bound * (1 - LAST_DIGITS)


def _is_proven(answer: Answer) -> bool:
    return answer.status == Status.OPTIMAL.value


def _timed(
    problem: Problem, options: dict[str, Any], limit_s: float, rel_gap: float = DEFAULT_REL_GAP
) -> tuple[Answer, dcreg.Certificate | None]:
    began = time.process_time()
    found = dcreg.register(
        *problem.clouds, **problem.keywords(), rel_gap=rel_gap, time_limit=WALL_PER_CPU * limit_s,
        options=dcreg.SolveOptions(
            **options, listener=lambda _: time.process_time() - began > limit_s
        ),
    )  # fmt: skip
    cpu_s = time.process_time() - began
    pose = found.T_target_source
    if found.certificate is not None and found.upper_bound < found.objective:
        pose = found.T_certified
    objective, _ = dcreg.objective(*problem.clouds, pose, problem.n_inliers)
    answer = Answer(
        options, found.status.value, pose.tolist(), objective, found.lower_bound, cpu_s, limit_s,
        found.certificate_scope,
    )  # fmt: skip
    return answer, found.certificate


def _checked(problem: Problem, answer: Answer, path: Path, limit_s: float) -> Answer:
    """Let the checker prove the bound of a certificate within a limited time."""
    began = time.process_time()
    allowed_s = CHECK_S if _is_proven(answer) else 2 * limit_s

    def progress(done: int, needed: int) -> None:
        spent_s = time.process_time() - began
        if spent_s > allowed_s or (spent_s > EARLY_S and spent_s * needed > allowed_s * done):
            raise _OutOfTimeError

    try:
        report = dcreg.verify(path, *problem.clouds, progress=progress)
    except _OutOfTimeError:
        return replace(answer, reason="the check took too long", check_s=allowed_s)
    check_s = time.process_time() - began
    if not report.accepted:
        return replace(answer, reason=report.reason, check_s=check_s)
    return replace(answer, checked_bound=report.lower_bound, check_s=check_s, reason="")


def _keep(answer: Answer, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, as_json(asdict(answer)))


def read_answer(path: Path) -> Answer | None:
    """Read a stored answer; None if there is none."""
    return Answer(**json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None
