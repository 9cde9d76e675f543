"""Prove the certificates of small problems exactly, and compare the intervals with the true optima."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import dcreg
from tests.fuzz.check import optimum
from tests.fuzz.problems import FuzzProblem, problem

SMALLEST = 3  # pairs; similarity poses fit two pairs exactly
REL_GAP = 0.1


class Outcome(NamedTuple):
    """`kind` is "proven", "exact fit" or "trivial" (a lower bound of 0); "wrong" if there is a fault."""

    kind: str
    fault: str
    report: dcreg.Report


def problems(rel_gap: float = REL_GAP) -> Iterator[FuzzProblem]:
    """Yield 2D problems of 2 to 7 points, always the same ones; those of even numbers have no leaves."""
    for number in itertools.count(1, 2):
        drawn = problem(number, "similarity2d")
        if drawn.n_inliers >= SMALLEST:
            yield with_gap(drawn, rel_gap)


def with_gap(small: FuzzProblem, rel_gap: float = REL_GAP) -> FuzzProblem:
    """Return a problem with a relative tolerance alone."""
    settings = {name: value for name, value in small.settings.items() if name != "abs_gap"}
    return replace(small, settings=settings | {"rel_gap": rel_gap})


def check(small: FuzzProblem) -> Outcome:
    """Solve a problem, and prove its certificate in integers."""
    result = small.solve()
    report = dcreg.verify(result.certificate, small.source, small.target, exact=True)
    if not report.accepted:
        return Outcome("wrong", f"refused: {report.reason}", report)
    truth, _, _ = optimum(small, result.gap_tol)  # in floating point
    slack = 1e-9 * truth + 1e-12 * result.certificate.unit**2
    if not report.lower_bound - slack <= truth <= report.upper_bound + slack:
        fault = f"[{report.lower_bound}, {report.upper_bound}] without the optimum {truth}"
        return Outcome("wrong", fault, report)
    if report.lower_bound > 0.0:
        return Outcome("proven", "", report)
    return Outcome("trivial" if report.is_trivial else "exact fit", "", report)
