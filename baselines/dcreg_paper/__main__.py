"""Run Algorithm 1 on a file: ``python -m baselines.dcreg_paper FILE.npz``.

The file holds the clouds, their centres and unit, the start box and the tolerance (`Case`). The command
prints boxes, bounds and CPU seconds, and the results that the file states, if any.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from baselines._shared.algorithm1 import algorithm_1
from baselines._shared.published import NormBound, SimilarityBound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Budget, Outcome

STATED = ("boxes", "upper_bound", "lower_bound")


class Case(NamedTuple):
    """A problem for Algorithm 1.

    Attributes
    ----------
    source, target : (n, d), (m, d) arrays
        Coordinates of the file.
    n_inliers : int
    source_centre, target_centre : (d,) arrays
    unit : float
        Clouds are searched minus their centres, divided by it.
    lower, upper : (4,) or (3,) arrays
        Start box: (s cos a, s sin a, t1, t2) in 2D; the translation of norm space in 3D.
    eps : float
        Tolerance, in squared units.
    """

    source: np.ndarray
    target: np.ndarray
    n_inliers: np.ndarray
    source_centre: np.ndarray
    target_centre: np.ndarray
    unit: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    eps: np.ndarray

    @classmethod
    def read(cls, path: Path) -> tuple[Case, dict[str, float]]:
        """Return the case of a file, and the results that it states."""
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in cls._fields if name not in archive.files]
            if missing:
                raise ValueError(
                    f"{path}: no array {missing[0]!r}; it needs {', '.join(cls._fields)}"
                )
            stated = {name: archive[name].item() for name in STATED if name in archive.files}
            return cls(*(archive[name] for name in cls._fields)), stated

    def solve(self, time_limit: float | None = None) -> Outcome:
        """Run Algorithm 1 on the case."""
        source = (self.source - self.source_centre) / self.unit
        target = (self.target - self.target_centre) / self.unit
        k, root = int(self.n_inliers), Box(self.lower, self.upper)
        with Budget(time_limit) as budget:
            bound: SimilarityBound | NormBound
            if source.shape[1] == 2:
                high = float(np.abs(self.upper[:2]).max())
                bound = SimilarityBound(
                    Similarity2D(source, target, k, (0.0, high), None, budget.stop)
                )
            else:
                bound = NormBound(Translation3D(source, target, k, None, budget.stop))
            return algorithm_1(bound, [root], float(self.eps), budget)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m baselines.dcreg_paper", description=__doc__)
    parser.add_argument("file", type=Path, help="a case, such as algorithm1_fish_def_03_0_40.npz")
    parser.add_argument("--time-limit", type=float, help="in seconds; default: none")
    arguments = parser.parse_args()
    try:
        case, stated = Case.read(arguments.file)
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    began = time.process_time()
    found = case.solve(arguments.time_limit)
    spent = time.process_time() - began
    rows = {
        "boxes": found.n_nodes,
        "upper_bound": found.upper_bound,
        "lower_bound": found.lower_bound,
    }
    print(f"{'':<14}{'found':>22}{'stated':>22}")
    for name, value in rows.items():
        print(f"{name:<14}{value:>22.12g}{stated.get(name, float('nan')):>22.12g}")
    print(
        f"status {found.status.value}, {found.n_assignments} assignments, {spent:.1f} s of CPU time"
    )


if __name__ == "__main__":
    main()
