"""Run Algorithm 1 on a file: ``python -m baselines.dcreg_paper FILE.npz``.

The file holds the clouds, their centres and unit, the start box and the tolerance (`Case`). The command
prints boxes, bounds and CPU seconds, and the results that the file states, if any.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from baselines._shared.algorithm1 import algorithm_1
from baselines._shared.published import NormBound, SimilarityBound
from dcreg.driver.options import check_positive
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import InputError, Problem
from dcreg.search import Box, Budget, Outcome

STATED = ("boxes", "upper_bound", "lower_bound")
MODELS = {2: "similarity2d", 3: "rigid3d"}  # by the dimension of the points


class Case(NamedTuple):
    """A problem for Algorithm 1.

    Attributes
    ----------
    source, target : (n, d), (m, d) arrays
        Coordinates of the file.
    n_inliers : int
    source_centre, target_centre : (d,) arrays
    unit : float
        The search subtracts the centres from the clouds and divides them by this unit.
    lower, upper : (4,) or (3,) arrays
        Start box of (s cos a, s sin a, t1, t2) in 2D, or of the translation in norm space in 3D.
    eps : float
        Tolerance, in squared units of the search.
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
        """Return the case of a file, and the results that it states.

        Raises
        ------
        InputError
            If the file cannot be read, or an array is missing or wrong.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                names = [name for name in (*cls._fields, *STATED) if name in archive.files]
                arrays = {name: archive[name] for name in names}
        except OSError as error:
            raise InputError(
                f"{path}: {error.strerror or error}; give the path of a case"
            ) from None
        except Exception:  # whatever numpy and zipfile raise for other files
            raise InputError(
                f"{path}: not an .npz file of plain arrays; it needs {', '.join(cls._fields)}"
            ) from None
        missing = [name for name in cls._fields if name not in arrays]
        if missing:
            raise InputError(f"{path}: no array {missing[0]!r}; it needs {', '.join(cls._fields)}")
        case = cls(*(arrays[name] for name in cls._fields))
        stated = {name: arrays[name] for name in STATED if name in arrays}
        try:
            case.check()
            for name, value in stated.items():
                _check_numbers(name, value, ())
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        return case, {name: value.item() for name, value in stated.items()}

    def check(self) -> None:
        """Refuse arrays that state no problem.

        Raises
        ------
        InputError
        """
        dim = self.source.shape[1] if self.source.ndim == 2 else 0
        if dim not in MODELS:
            raise InputError(f"source: shape {self.source.shape}; give (n, 2) or (n, 3)")
        if self.n_inliers.shape != () or self.n_inliers.dtype.kind not in "iu":
            raise InputError(f"n_inliers: {self.n_inliers.tolist()!r} is not an integer; give one")
        Problem(self.source, self.target, self.n_inliers.item(), MODELS[dim])  # checks all three
        n_parameters = 4 if dim == 2 else 3
        shapes = {
            "source_centre": (dim,), "target_centre": (dim,), "unit": (),
            "lower": (n_parameters,), "upper": (n_parameters,), "eps": (),
        }  # fmt: skip
        for name, shape in shapes.items():
            _check_numbers(name, getattr(self, name), shape)
        check_positive("unit", float(self.unit))
        check_positive("eps", float(self.eps), minimum=0.0)
        if not (self.lower <= self.upper).all():
            raise InputError(
                f"lower: {self.lower.tolist()} exceeds upper: {self.upper.tolist()}; exchange them"
            )

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


def _check_numbers(name: str, value: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape, or of anything but finite numbers."""
    if value.shape != shape or value.dtype.kind not in "fiu" or not np.isfinite(value).all():
        needed = f"{shape[0]} finite numbers" if shape else "one finite number"
        raise InputError(f"{name}: {value.tolist()!r}; give {needed}")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m baselines.dcreg_paper", description=__doc__)
    parser.add_argument("file", type=Path, help="a case, such as algorithm1_fish_def_03_0_40.npz")
    parser.add_argument("--time-limit", type=float, help="in seconds; default: none")
    arguments = parser.parse_args()
    try:
        check_positive("--time-limit", arguments.time_limit)
        case, stated = Case.read(arguments.file)
    except InputError as error:
        parser.exit(2, f"error: {error}\n")
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
