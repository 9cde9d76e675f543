"""Solve problems on request: ``python solve_server.py PROBLEMS.json``, for `tests.bench.interleaved`.

The process imports the `dcreg` that PYTHONPATH names and nothing else of a checkout, so that it also runs
with older versions. Each line of the input is the number of a problem; each line of the output is the
CPU time and the work of its solve.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

import dcreg


def main() -> None:
    problems = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    for line in sys.stdin:
        given, options = problems[int(line)]
        clouds = [np.asarray(given[name]) for name in ("source", "target")]
        rest = {name: value for name, value in given.items() if name not in ("source", "target")}
        began = time.process_time()
        result = dcreg.register(*clouds, **rest, options=dcreg.SolveOptions(**options))
        spent = time.process_time() - began
        answer = {
            "cpu_s": spent,
            "status": result.status.value,
            "n_nodes": result.n_nodes,
            "n_assignments": result.n_assignments,
        }
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
