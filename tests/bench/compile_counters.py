"""What is compiled when needed: functions, specialisations and lines of LLVM's input.

``python -m tests.bench.compile_counters`` prints the counters and the stored ones of a first call of
`register` in 2D and in 3D, and of the covers after one in 3D: only long searches compile them.
``--accept`` stores the counters. Compile time cannot be asserted on a shared machine, these counters can.
Use the pinned version of Numba, because other versions generate other code.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
STORED = Path(__file__).with_name("compile_counters.json")
COMMAND = "python -m tests.bench.compile_counters --accept"
MODELS = {"2d": "similarity2d", "3d": "rigid3d"}
PROCESSES = (("2d",), ("3d", "covers"))  # cases, in turn in one process each
N_POINTS = 40  # above 1,000 pairs, a 3D search compiles all of its kernels
MARGIN = 0.1


def count(*cases: str) -> dict[str, dict[str, int]]:
    """Count what each case compiles in turn, in a new process with an empty cache.

    The counters describe LLVM's input, so its optimisation is left out. Numba does not cache such code,
    and its warnings about that are hidden.
    """
    quick = {"NUMBA_OPT": "0", "PYTHONWARNINGS": "ignore"}
    with tempfile.TemporaryDirectory() as cache:
        done = subprocess.run(
            [sys.executable, "-m", "tests.bench.compile_counters", "--here", *cases], cwd=ROOT,
            env=os.environ | quick | {"NUMBA_CACHE_DIR": cache}, check=True, stdout=subprocess.PIPE,
            text=True,
        )  # fmt: skip
    counters: dict[str, dict[str, int]] = json.loads(done.stdout.splitlines()[-1])
    return counters


def _compile(case: str) -> None:
    """Register a small problem, or confine small problems by the covers."""
    import numpy as np

    import dcreg
    from dcreg.driver.warm_up import compile_covers

    if case == "covers":
        compile_covers()
        return
    generator = np.random.default_rng(0)
    source = generator.standard_normal((N_POINTS, int(case[0])))
    target = source + 0.01 * generator.standard_normal(source.shape)
    dcreg.register(source, target, n_inliers=N_POINTS - 1, model=MODELS[case], node_limit=200)


def _count_here(case: str) -> dict[str, int]:
    """Count what a case compiles in this process."""
    import llvmlite.binding as llvm
    from numba.core import event

    lines, parse = [], llvm.parse_assembly

    def counting(text: str, *arguments: Any) -> Any:
        lines.append(text.count("\n"))
        return parse(text, *arguments)

    compiled = event.RecordingListener()
    llvm.parse_assembly = counting
    try:
        with event.install_listener("numba:compile", compiled):
            _compile(case)
    finally:
        llvm.parse_assembly = parse
    codes = [
        each.data["dispatcher"].py_func.__code__ for _, each in compiled.buffer if each.is_start
    ]
    return {"functions": len(set(codes)), "specialisations": len(codes), "ir_lines": sum(lines)}


def stored() -> dict[str, dict[str, int]]:
    """Return the accepted counters by case."""
    content: dict[str, dict[str, int]] = json.loads(STORED.read_text(encoding="utf-8"))
    return content


def growth(found: dict[str, int], accepted: dict[str, int]) -> list[str]:
    """Name the counters that grew by more than `MARGIN`."""
    return [
        f"{name} grew by {100 * (value / accepted[name] - 1):.0f} %: {value}, accepted {accepted[name]}"
        for name, value in found.items()
        if value > (1 + MARGIN) * accepted[name]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--accept", action="store_true", help="store the counters")
    parser.add_argument("--here", nargs="+", metavar="CASE", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.here:
        print(json.dumps({case: _count_here(case) for case in arguments.here}))
        return
    found = {case: each for cases in PROCESSES for case, each in count(*cases).items()}
    before = stored() if STORED.exists() else {}
    for case, counters in found.items():
        old = before.get(case, {})
        shown = (
            f"{name} {value} (stored {old.get(name, '-')})" for name, value in counters.items()
        )
        print(f"{case}: {', '.join(shown)}")
    if arguments.accept:
        STORED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
