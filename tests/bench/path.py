"""The path of one warm `register` call through the files of the library.

``python -m tests.bench.path 2d`` (or ``3d``) prints the number of distinct files of ``dcreg`` that the
call enters, how many changes of file its deepest chain of calls has, that chain, and all files in the
order of their first entry. Compiled code is not seen: a kernel is entered by the call from Python.
"""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path
from types import FrameType

import numpy as np

import dcreg

LIBRARY = Path(dcreg.__file__).parent
# By default a search that takes long, on a busy machine, asks for its prospect.
PROVE = dcreg.SolveOptions(prove=True)
MODELS = {"2d": "similarity2d", "3d": "rigid3d"}


@functools.cache
def library_file(filename: str) -> str | None:
    """Return a file's path within the library; None for files elsewhere."""
    path = Path(filename)
    return path.relative_to(LIBRARY).as_posix() if path.is_relative_to(LIBRARY) else None


class Recorder:
    """A profile function that records entered files and the deepest chain of file changes."""

    def __init__(self) -> None:
        self.files: dict[str, None] = {}  # in the order of their first entry
        self.deepest: list[str] = []

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        if event != "call" or library_file(frame.f_code.co_filename) is None:
            return
        chain: list[str] = []
        caller: FrameType | None = frame
        while caller is not None:
            name = library_file(caller.f_code.co_filename)
            if name is not None and chain[-1:] != [name]:
                chain.append(name)
            caller = caller.f_back
        self.files.setdefault(chain[0])
        if len(chain) > len(self.deepest):
            self.deepest = chain[::-1]

    @property
    def depth(self) -> int:
        """File changes of the deepest chain."""
        return len(self.deepest) - 1


def record(dimension: str) -> Recorder:
    """Record the second of two equal calls of `register`; the first one compiles and loads."""
    rng = np.random.default_rng(0)
    source = rng.random((30, int(dimension[0])))
    target = source + 0.01 * rng.standard_normal(source.shape)
    recorder = Recorder()
    for profile in (None, recorder):
        sys.setprofile(profile)
        try:
            dcreg.register(
                source, target, n_inliers=24, model=MODELS[dimension], time_limit=10, options=PROVE
            )
        finally:
            sys.setprofile(None)
    return recorder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dimension", choices=MODELS)
    found = record(parser.parse_args().dimension)
    print(f"{len(found.files)} files, at most {found.depth} file changes deep")
    print("deepest chain:", " > ".join(found.deepest))
    print(*found.files, sep="\n")


if __name__ == "__main__":
    main()
