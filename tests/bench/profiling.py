"""Where a solve spends its time: ``make profile``. The rule is 80 % in compiled kernels.

CPU time, so that other work on the machine counts little. A compiled function shows as one entry with
everything it calls.
"""

from __future__ import annotations

import cProfile
import pstats
import sys
import time

import dcreg
from tests.bench.cases import CASES

DEFAULT = (
    "mixed/tight", "half/tight", "mixed3d/tight", "goicp/full",
    "embedded-mixed/tight", "embedded-norm3d/tight",
)  # fmt: skip
N_LINES = 8


def profile(name: str) -> None:
    """Profile the first subject of a case and print shares of its CPU time."""
    case = CASES[name]
    subject = case.subjects[0]
    case.solve(subject, time_limit=1.0)  # loads the kernels
    profiler = cProfile.Profile(time.process_time)
    profiler.enable()
    result = case.solve(subject, time_limit=20.0)
    profiler.disable()
    entries = [
        (own, f"{file.rpartition('dcreg/')[2]}: {function}", "/kernels" in file)
        for (file, _, function), (_, _, own, _, _) in pstats.Stats(profiler).stats.items()
    ]
    total = sum(own for own, _, _ in entries)
    compiled = sum(own for own, _, is_kernel in entries if is_kernel)
    print(f"{name}, {subject}: {result.status.value}, {result.n_nodes} nodes, {total:.2f} s CPU")
    print(f"  {100 * compiled / total:5.1f} %  in compiled kernels")
    for own, label, is_kernel in sorted(entries, reverse=True)[:N_LINES]:
        print(f"  {100 * own / total:5.1f} %  {label}{'' if is_kernel else '  (Python)'}")


if __name__ == "__main__":
    dcreg.warm_up()
    for chosen in sys.argv[1:] or DEFAULT:
        if all(subject.is_here for subject in CASES[chosen].subjects):
            profile(chosen)
        else:
            print(f"{chosen}: not measured, DCREG_DATA_MIRROR names no folder")
