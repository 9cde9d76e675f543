"""Processor time of a first call of `register`, against an older checkout.

``python -m tests.bench.first_call OLD_CHECKOUT`` runs both checkouts in turn, each time in a new process
with an empty compile cache, and prints the smallest times and their ratio. Nothing else should run.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Model, dimension, points: 33 x 33 pairs of points need more kernels than 10 x 10.
CALLS = [("similarity2d", 2, 10), ("rigid3d", 3, 10), ("rigid3d", 3, 33)]
CODE = """
import numpy as np, dcreg
generator = np.random.default_rng(0)
source = generator.standard_normal(({n}, {dim}))
target = source + 0.01 * generator.standard_normal(source.shape)
dcreg.register(source, target, n_inliers={n} - 1, model="{model}", node_limit=200)
"""


def first_call_s(checkout: Path, model: str, dim: int, n: int) -> float:
    """Processor seconds of a new process that calls `register` once."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as cache:
        subprocess.run(
            [sys.executable, "-c", CODE.format(model=model, dim=dim, n=n)], cwd=cache, check=True,
            env=os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(checkout)},
        )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", type=Path, help="a checkout of an earlier version")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    print("model         points   old [s]   new [s]   ratio")
    for model, dim, n in CALLS:
        times = [
            [first_call_s(checkout.resolve(), model, dim, n) for checkout in (arguments.old, ROOT)]
            for _ in range(arguments.rounds)
        ]
        old, new = map(min, zip(*times, strict=True))
        print(f"{model:<13} {n:>6} {old:>9.1f} {new:>9.1f} {new / old:>7.2f}", flush=True)


if __name__ == "__main__":
    main()
