"""A page for the answer to a question about poses: the clouds at each of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dcreg.answer import Answer
from dcreg.plot.page import html_file, page_title, write_page
from dcreg.plot.registration import clouds_figure
from dcreg.problem import apply_pose

_MAX_POSES = 8  # drawn


def plot_answer(
    source: np.ndarray,
    target: np.ndarray,
    answer: Answer,
    path: str | Path,
    *,
    names: tuple[str, str] = ("source", "target"),
) -> None:
    """Write a page with the clouds at each pose of an answer.

    Parameters
    ----------
    source, target : (n, d) and (m, d) arrays, d = 2 or 3
    answer : Certified, Alternatives, MaxInliers or Report
    path : str or Path
        The ``.html`` file to write.
    names : (str, str)
        Names of the clouds on the page.

    Raises
    ------
    InputError
        If `path` has another suffix.
    """
    drawn = list(answer.poses.items())[:_MAX_POSES]
    facts = list(answer.entries())[1:]
    write_page(
        html_file(path),
        page_title(answer.question, names),
        answer.answer,
        {name: clouds_figure(apply_pose(T, source), target) for name, T in drawn},
        warnings=answer.warnings,
        facts=[each for each in facts if each[0] != "warning"],
    )
