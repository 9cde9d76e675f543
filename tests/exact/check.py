"""Prove the certificate of one small problem exactly, and compare the interval with the true optimum."""

from __future__ import annotations

from typing import NamedTuple

import dcreg
from tests.fuzz.check import optimum
from tests.fuzz.problems import FuzzProblem, problem


class Outcome(NamedTuple):
    """`kind` is "proven", "exact fit" or "trivial" (a lower bound of 0); "" if it is wrong."""

    kind: str
    fault: str
    report: dcreg.Report


def drawn(number: int) -> FuzzProblem:
    """Problem `number`: 2D clouds of 2 to 7 points; those of even numbers have no certificate."""
    return problem(2 * number + 1, "similarity2d")


def check(number: int) -> Outcome:
    """Solve problem `number`, and prove its certificate in integers."""
    small = drawn(number)
    result = small.solve()
    report = dcreg.verify(result.certificate, small.source, small.target, exact=True)
    if not report.accepted:
        return Outcome("", f"refused: {report.reason}", report)
    truth, _, _ = optimum(small, result.gap_tol)  # in floating point
    slack = 1e-9 * truth + 1e-12 * result.certificate.unit**2
    if not report.lower_bound - slack <= truth <= report.upper_bound + slack:
        fault = f"[{report.lower_bound}, {report.upper_bound}] without the optimum {truth}"
        return Outcome("", fault, report)
    if report.lower_bound > 0.0:
        return Outcome("proven", "", report)
    return Outcome("trivial" if report.is_trivial else "exact fit", "", report)
