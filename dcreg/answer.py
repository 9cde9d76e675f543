"""What the answers to all questions have in common: text, JSON and file."""

from __future__ import annotations

import abc
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.files import as_json, write_text


class Answer(abc.ABC):
    """The answer to a question about poses; ``print(answer)`` shows it.

    Attributes
    ----------
    question : str
        Title of its page.
    """

    question: ClassVar[str]

    @property
    @abc.abstractmethod
    def answer(self) -> str:
        """The answer in a sentence."""

    @property
    @abc.abstractmethod
    def poses(self) -> dict[str, np.ndarray]:
        """The poses by name."""

    @property
    def warnings(self) -> list[str]:
        """Possible problems with the answer."""
        return []

    @abc.abstractmethod
    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary, the answer first."""

    @abc.abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""

    def to_json(self, **more: Any) -> str:
        """Return `to_dict`, the version and `more` keys (such as file names) as JSON."""
        return as_json({**self.to_dict(), **more, "dcreg_version": __version__})

    def write_json(self, path: str | Path, **more: Any) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.to_json(**more) + "\n")

    def __str__(self) -> str:
        return text.listing(list(self.entries()))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.answer}>"
