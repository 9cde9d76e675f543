"""Run py_goicp on one problem in a separate process, with JSON as input and output.

The library prints to standard output and cannot be interrupted; the parent kills it at the time limit.
"""

from __future__ import annotations

import json
import math
import os
import sys
from typing import Any


def register(problem: dict[str, Any]) -> dict[str, Any]:
    """Return rotation and translation for lists of points and settings of the library."""
    import py_goicp

    def points(rows: list[list[float]]) -> list[Any]:
        return [py_goicp.POINT3D(*row) for row in rows]

    solver = py_goicp.GoICP()
    solver.loadModelAndData(
        len(problem["target"]), points(problem["target"]),
        len(problem["source"]), points(problem["source"]),
    )  # fmt: skip
    rotations, translations = py_goicp.ROTNODE(), py_goicp.TRANSNODE()
    rotations.a = rotations.b = rotations.c = -math.pi
    rotations.w = 2 * math.pi
    translations.x = translations.y = translations.z = -problem["translation_half_width"]
    translations.w = 2 * problem["translation_half_width"]
    solver.setInitNodeRot(rotations)
    solver.setInitNodeTrans(translations)
    solver.MSEThresh = problem["mse_threshold"]
    solver.trimFraction = problem["trim_fraction"]
    solver.doTrim = problem["trim_fraction"] > 0
    solver.setDTSizeAndFactor(problem["dt_size"], problem["dt_factor"])
    solver.BuildDT()
    solver.Register()
    return {
        "rotation": [list(row) for row in solver.optimalRotation()],
        "translation": list(solver.optimalTranslation()),
    }


if __name__ == "__main__":
    # Output of the library goes to standard error instead.
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    json.dump(register(json.load(sys.stdin)), answer)
    answer.flush()
