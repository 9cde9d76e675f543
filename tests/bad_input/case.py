"""One piece of bad input and what its message must say."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

A2, B2 = (np.random.default_rng(seed).random((8, 2)) for seed in (0, 1))
A3, B3 = (np.random.default_rng(seed).random((8, 3)) for seed in (2, 3))
# Good files that lie in the folder of every case.
CLOUDS = {"a2.txt": A2, "b2.txt": B2, "a3.txt": A3, "b3.txt": B3}


@dataclass(frozen=True)
class Case:
    """Bad input to a command line, or to a function.

    Attributes
    ----------
    area, name : str
        Together unique.
    run : sequence of str, or callable
        Arguments of ``dcreg``, or a function that must raise a ValueError.
    words : sequence of str
        What the message must hold: the file or field, the value, the remedy.
    files : dict
        Content of further files, by name; None: a folder.
    code : int
        Expected exit code.
    """

    area: str
    name: str
    run: Sequence[str] | Callable[[], object]
    words: Sequence[str]
    files: dict[str, bytes | None] = field(default_factory=dict)
    code: int = 2


def register(*options: str, dim: int = 2, **changes: str | None) -> list[str]:
    """A good call of ``dcreg register``, options changed or, with None, left out."""
    return _call("register", options, dim, changes, n_inliers="6")


def sweep(*options: str, dim: int = 2, **changes: str | None) -> list[str]:
    """A good call of ``dcreg sweep``."""
    return _call("sweep", options, dim, changes, n_inliers="4:8:2")


def npz(**arrays: object) -> bytes:
    """Content of an .npz file."""
    stream = io.BytesIO()
    np.savez(stream, **{name: np.asarray(array) for name, array in arrays.items()})
    return stream.getvalue()


def _call(
    command: str, options: Sequence[str], dim: int, changes: dict[str, str | None], n_inliers: str
) -> list[str]:
    values: dict[str, str | None] = {
        "source": f"a{dim}.txt",
        "target": f"b{dim}.txt",
        "model": "similarity2d" if dim == 2 else "rigid3d",
        "n_inliers": n_inliers,
        "time_limit": "5",
        **changes,
    }
    call = [command, *(values.pop(name) or "" for name in ("source", "target"))]
    for name, value in values.items():
        if value is not None:
            call += [f"--{name.replace('_', '-')}", value]
    return [*call, *options]
