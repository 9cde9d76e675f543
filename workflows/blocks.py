"""Blocks of paired instances: the part of an experiment that is run if claims need different trials.

A block is one trial of a test: all shapes, at the levels that some comparison needs. `Needs` states on
how many trials each method runs, per test and level. The other methods are planned and not run on a
block: their runs have the outcome *not needed*.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workflows.compose import ConfigError
from workflows.integrity import SUMS, is_damaged, sealed_file

EVIDENCE = "evidence"  # folder of the tables of blocks, in that of their experiment
FORECASTS = "forecast.csv"  # in results/evidence: forecast and actual time of each block
VERDICTS = "verdicts.csv"  # next to it: the verdicts after some hours
OPEN_CLAIMS = "open.csv"  # next to it: what the open claims need
RUN_HOURS = "hours of runs"  # a column of it
NEEDS = "needs.json"  # file of `Needs` in it
REST = "*"  # all levels that are not named

Numbers = int | Mapping[str, int]  # of trials: at all levels, or by level and `REST`


@dataclass(frozen=True)
class Needs:
    """Numbers of trials: test -> method -> one number for all levels, or one per level."""

    trials: Mapping[str, Mapping[str, Numbers]]

    @classmethod
    def read(cls, path: Path) -> Needs:
        """Read a file that `write` wrote.

        Raises
        ------
        ConfigError
        """
        if path.is_file() and is_damaged(path):
            raise ConfigError(
                f"{path}: damaged, its SHA-256 differs from that in {SUMS}; remove it"
            )
        try:
            return cls(_checked(json.loads(path.read_text(encoding="utf-8"))))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: not a list of blocks: {error}; remove it") from error

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with sealed_file(path) as part:
            part.write_text(json.dumps(self.trials, indent=1, sort_keys=True), encoding="utf-8")

    def of(self, method: str, test: str, level: float) -> int:
        """Return on how many trials of a level a method runs."""
        return _at(self.trials.get(test, {}).get(method, 0), f"{level:g}")

    def users(self, test: str, level: float, trial: int) -> tuple[str, ...]:
        """Return the methods that run on a trial of a test."""
        own = self.trials.get(test, {})
        return tuple(sorted(method for method in own if self.uses(method, test, level, trial)))

    def uses(self, method: str, test: str, level: float, trial: int) -> bool:
        """Tell whether a method runs on a trial of a test."""
        return trial < self.of(method, test, level)

    def of_all(self, test: str, methods: Iterable[str], levels: Sequence[float]) -> int:
        """Return the number of blocks with these levels of a test that all of these methods have."""
        numbers = (self.of(method, test, level) for method in methods for level in levels)
        return min(numbers, default=0)

    def with_block(self, test: str, methods: Sequence[str], levels: Sequence[float]) -> Needs:
        """Return needs in which all of these methods have the next block that some of them lack.

        Only those run that do not have it, so a method that skipped blocks starts with the first one.
        """
        number = self.of_all(test, methods, levels) + 1
        more: dict[str, Numbers] = {}
        for method in methods:
            own = _by_level(self.trials.get(test, {}).get(method, 0))
            added = {f"{level:g}": max(number, self.of(method, test, level)) for level in levels}
            more[method] = {**own, **added}
        return self.joined(Needs({test: more}))

    def joined(self, other: Needs) -> Needs:
        """Return the larger of both numbers for each test, method and level."""
        trials = {test: dict(own) for test, own in self.trials.items()}
        for test, methods in other.trials.items():
            own = trials.setdefault(test, {})
            for name, numbers in methods.items():
                own[name] = _larger(own.get(name, 0), numbers)
        return Needs(trials)


def chosen_trials(folder: Path) -> str:
    """Return a warning for a run of all trials of an experiment that has only needed ones; else ""."""
    if not (folder / EVIDENCE / NEEDS).is_file():
        return ""
    return (
        f"{folder / EVIDENCE} has only the trials that claims need; this command runs every trial. "
        f"To run only needed ones: python -m reports evidence --experiments {folder.name}"
    )


def _by_level(numbers: Numbers) -> Mapping[str, int]:
    return {REST: numbers} if isinstance(numbers, int) else numbers


def _at(numbers: Numbers, level: str) -> int:
    own = _by_level(numbers)
    return own.get(level, own.get(REST, 0))


def _larger(one: Numbers, other: Numbers) -> Numbers:
    levels = sorted({REST, *_by_level(one), *_by_level(other)})
    found = {level: max(_at(one, level), _at(other, level)) for level in levels}
    rest = found[REST]
    named = {level: number for level, number in found.items() if number != rest}
    return {**named, **({REST: rest} if rest else {})} if named else rest


def _checked(content: Any) -> dict[str, dict[str, Numbers]]:
    for test, methods in content.items() if isinstance(content, dict) else [("file", content)]:
        if not isinstance(methods, dict):
            raise ValueError(f"{test} must be a mapping")
        for method, numbers in methods.items():
            for number in numbers.values() if isinstance(numbers, dict) else [numbers]:
                if not isinstance(number, int) or number < 0:
                    raise ValueError(f"{test}: {method}: {number!r} is not a number of blocks")
    return content
