"""What the answers to all questions have in common: text, JSON and file."""

from __future__ import annotations

import abc
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from dcreg import text
from dcreg.files import Document


class Answer(Document):
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

    def __str__(self) -> str:
        return text.listing(list(self.entries()))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.answer}>"
