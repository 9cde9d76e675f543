"""Pilots: first runs of methods on tests where they have no measured time, for a better forecast."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from reports.campaign.forecast import Forecast, Pair
from workflows.blocks import Needs
from workflows.config import ConfigError, Experiment, Selection
from workflows.integrity import is_damaged, sealed_file

# A pilot precedes a step if the time limits of its unmeasured runs sum to at least this many seconds.
PILOT_S = 600.0
PILOTS = "pilots.json"  # file of the pilots that were begun, next to the needs


def unmeasured(step: Forecast) -> list[Pair]:
    """Return the methods and tests of the next step without a measured run, if they may take long."""
    return list(step.unmeasured) if sum(step.unmeasured.values()) >= PILOT_S else []


def pilots(pairs: list[Pair], experiment: Experiment, needs: Needs) -> Iterator[Selection]:
    """Yield the part of each test to run: two of the needed levels of the first trial, on all shapes.

    The levels are the quartiles: between them, times grow nearly linearly, and beyond them a limit or
    the start of a process often makes them constant.
    """
    for test in dict.fromkeys(test for _, test in pairs):
        methods = [method for method, own in pairs if own == test]
        levels = sorted(
            {
                level
                for entry in experiment.datasets
                for level in entry.tests.get(test, ())
                if needs.of_all(test, methods, [level])
            }
        )
        quartiles = {levels[len(levels) // 4], levels[3 * len(levels) // 4]}
        yield Selection(methods=methods, tests=[test], levels=sorted(quartiles), trials=[0])


def store(parts: Sequence[Selection], path: Path) -> None:
    """Store pilots before they are begun, so that the next call finishes them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with sealed_file(path) as file:
        file.write_text(json.dumps([part.model_dump() for part in parts]), encoding="utf-8")


def begun(path: Path) -> list[Selection]:
    """Return the pilots that were begun and have not ended.

    Raises
    ------
    ConfigError
    """
    if not path.is_file():
        return []
    if is_damaged(path):
        raise ConfigError(f"{path}: damaged; remove it")
    try:
        return [Selection.model_validate(each) for each in json.loads(path.read_text("utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: not a list of pilots: {error}; remove it") from error
