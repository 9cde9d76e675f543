"""Blocks of paired instances: the part of an experiment that is run if claims need different trials.

A block consists of all levels and shapes of a test with the same number of trial. `Needs` says how many
blocks of a test each method is run on. The other methods of a block are planned and not run: their runs
have the outcome *not needed*.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dcreg.files import whole_file
from workflows.compose import ConfigError

EVIDENCE = "evidence"  # folder of the tables of blocks, in that of their experiment
NEEDS = "needs.json"  # file of `Needs` in it


@dataclass(frozen=True)
class Needs:
    """The numbers of blocks: test -> method -> number of its trials."""

    trials: Mapping[str, Mapping[str, int]]

    @classmethod
    def read(cls, path: Path) -> Needs:
        """Read a file that `write` wrote.

        Raises
        ------
        ConfigError
        """
        try:
            return cls(_checked(json.loads(path.read_text(encoding="utf-8"))))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: not a list of blocks: {error}; remove it") from error

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            part.write_text(json.dumps(self.trials, indent=1, sort_keys=True), encoding="utf-8")

    def blocks(self, test: str) -> int:
        """Return the number of blocks of a test that some method needs."""
        return max(self.trials.get(test, {}).values(), default=0)

    def needs(self, method: str, test: str, trial: int) -> bool:
        return trial < self.trials.get(test, {}).get(method, 0)

    def of_all(self, test: str, methods: Iterable[str]) -> int:
        """Return the number of blocks of a test that all of these methods have."""
        own = self.trials.get(test, {})
        return min((own.get(method, 0) for method in methods), default=0)

    def with_block(self, test: str, methods: Sequence[str]) -> Needs:
        """Return needs in which all of these methods have one more block of a test.

        Only those run that do not have it, so a method that skipped blocks starts with the first one.
        """
        number, own = self.of_all(test, methods) + 1, self.trials.get(test, {})
        more = {method: max(number, own.get(method, 0)) for method in methods}
        return Needs({**self.trials, test: {**own, **more}})


def _checked(content: Any) -> dict[str, dict[str, int]]:
    for test, methods in content.items() if isinstance(content, dict) else [("file", content)]:
        if not isinstance(methods, dict):
            raise ValueError(f"{test} must be a mapping")
        for method, number in methods.items():
            if not isinstance(number, int) or number < 0:
                raise ValueError(f"{test}: {method}: {number!r} is not a number of blocks")
    return content
