"""Pilots: the first runs of methods on tests without measured times, for the forecast of their block."""

from __future__ import annotations

from collections.abc import Iterator

from reports.campaign.choice import Option
from reports.campaign.forecast import Times
from workflows.config import Experiment, Selection
from workflows.outlook import runs_here

# Unmeasured seconds of a step from which a pilot is worth its start.
PILOT_S = 600.0
Pair = tuple[str, str]  # method and test


def unmeasured(option: Option, times: Times, experiment: Experiment) -> list[Pair]:
    """Return the methods and tests of the next step without a measured run, if they take long."""
    if option.step.unseen_seconds < PILOT_S:
        return []
    return [
        (method, test)
        for test, own in option.needs.trials.items()
        for method in own
        if not times.has_measured(method, test) and runs_here(experiment.method(method))
    ]


def pilots(pairs: list[Pair], experiment: Experiment) -> Iterator[Selection]:
    """Yield the part of each test to run: two levels of the first trial, on all shapes.

    The levels are the quartiles: between them, times grow nearly linearly, and beyond them a limit or
    the start of a process often makes them constant.
    """
    for test in dict.fromkeys(test for _, test in pairs):
        levels = sorted(
            {level for entry in experiment.datasets for level in entry.tests.get(test, ())}
        )
        quartiles = {levels[len(levels) // 4], levels[3 * len(levels) // 4]}
        methods = [method for method, own in pairs if own == test]
        yield Selection(methods=methods, tests=[test], levels=sorted(quartiles), trials=[0])
