"""What a user writes: mypy --strict checks it against the types of the library."""

from pathlib import Path
from typing import assert_type

import numpy as np
from numpy.typing import NDArray

import dcreg


def registered(source: NDArray[np.float64], target: NDArray[np.float64]) -> dcreg.Result:
    options = dcreg.SolveOptions(threads=2)
    return dcreg.register(
        source, target, n_inliers=10, model="similarity2d", time_limit=5.0, options=options
    )


def report(result: dcreg.Result) -> str:
    assert_type(result.status, dcreg.Status)
    assert_type(result.lower_bound, float)
    pose = result.T_target_source
    assert_type(pose, np.ndarray)
    runner_up = result.runner_up
    other = "" if runner_up is None else f", runner-up {runner_up.objective_ratio:g}"
    return f"{result.status.value}: {result.lower_bound:g}{other}, scale {result.scale:g}"


def swept(source: NDArray[np.float64], target: NDArray[np.float64]) -> dcreg.SweepResult:
    found = dcreg.sweep(source, target, model="rigid3d", n_inliers=[5, 10])
    assert_type(found, dcreg.SweepResult)
    return found


def verified(path: Path, source: NDArray[np.float64], target: NDArray[np.float64]) -> bool:
    checked = dcreg.verify(path, source, target)
    assert_type(checked, dcreg.Report)
    return checked.accepted


if __name__ == "__main__":
    cloud = dcreg.read_points("cloud.txt")
    try:
        print(report(registered(cloud, cloud + 0.1)))
    except dcreg.InputError as error:
        print(error)
