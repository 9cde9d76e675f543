"""``python -m workflows.studies.questions``: every question about one pair of 3DMatch fragments.

The table has two columns of answers. In the first one, the clouds are 100 keypoints of each of two
overlapping fragments, and the feasible pairs join every source keypoint to the target keypoints with the
nearest descriptors. In the second one, the clouds are the keypoints with a counterpart within 0.1 m at
the official pose (the ground truth), and all pairs are feasible. Apart from this selection, only
`certify` and the ranges of poses receive the official pose. The page *Questions* of the manual includes
the table.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

import dcreg
from data.registry import dataset
from data.threedmatch.loader import Loader
from dcreg.files import write_text
from dcreg.problem import angle_between_deg, apply_pose, largest_matching
from dcreg.text import percent
from workflows.studies.refute import Keypoints, feasible_pairs, keypoints

SCENE, OVERLAP = "7-scenes-redkitchen", 0.6
DISTANCE = 0.1  # metres
TABLE = Path(__file__).parents[2] / "docs" / "tables" / "questions.md"


@dataclass(frozen=True)
class Asked:
    """A pair of clouds with its official pose and the arguments of the questions.

    Attributes
    ----------
    clouds : (source, target)
    T_official : (4, 4) array
    distinct : (n,) array
        Weights of the source points, see `distinctness`.
    limit : float
        Seconds per question.
    candidates : array, optional
    n_inliers : int, optional
        Default: the number of pairs within `DISTANCE` that `max_inliers` finds.
    """

    clouds: tuple[np.ndarray, np.ndarray]
    T_official: np.ndarray
    distinct: np.ndarray
    limit: float
    candidates: np.ndarray | None = None
    n_inliers: int | None = None

    def register(self, model: str = "rigid3d", **more: Any) -> dcreg.Result:
        """Register the clouds with more keywords."""
        return dcreg.register(*self.clouds, **self.given | {"model": model} | more)

    @property
    def given(self) -> dict[str, Any]:
        """The keywords of all questions."""
        given = {"candidates": self.candidates, "n_inliers": self.n_inliers}
        return {
            "model": "rigid3d",
            "time_limit": self.limit,
            **{name: value for name, value in given.items() if value is not None},
        }

    def described(self, found: dcreg.Result) -> str:
        """Return a result in words."""
        shift = np.linalg.norm(
            apply_pose(found.T_target_source, np.zeros((1, 3)))
            - apply_pose(self.T_official, np.zeros((1, 3)))
        )
        angle = angle_between_deg(found.T_target_source, self.T_official)
        return f"{proven(found)}; {angle:.1f}° and {shift:.2f} m from the official pose"


def main(
    nearest: Annotated[int, typer.Option(help="feasible pairs of a source keypoint")] = 5,
    limit: Annotated[float, typer.Option(help="seconds per question")] = 60.0,
    out: Annotated[Path, typer.Option(help="file for the table")] = TABLE,
) -> None:
    """Print a table of questions and answers, and write it for the manual."""
    loader = dataset("threedmatch")
    assert isinstance(loader, Loader)
    instance = loader.load(SCENE, "3DMatch", OVERLAP, 0, None)
    source, target = (keypoints(SCENE, int(instance.info[side])) for side in ("src", "ref"))
    candidates = feasible_pairs(source, target, nearest)
    distinct = distinctness(source, target)
    every = Asked((source.points, target.points), instance.T_true, distinct, limit, candidates)
    moved = apply_pose(instance.T_true, source.points)
    columns = largest_matching(cdist(moved, target.points) <= DISTANCE)
    rows = np.flatnonzero(columns >= 0)
    paired = (source.points[rows], target.points[columns[rows]])
    some = Asked(paired, instance.T_true, distinct[rows], limit, None, len(rows))
    table = written(dict(answers(every)), dict(answers(some)), len(rows))
    typer.echo(table)
    write_text(out, table)


def distinctness(source: Keypoints, target: Keypoints) -> np.ndarray:
    """Return the distance to the second nearest descriptor, divided by that to the nearest one."""
    distances, _ = cKDTree(target.features).query(source.features, k=2)
    return np.asarray(distances[:, 1] / np.maximum(distances[:, 0], 1e-9))


def written(every: dict[str, str], some: dict[str, str], count: int) -> str:
    """Return the table in Markdown."""
    head = ["question", "100 keypoints", f"{count} keypoints with a counterpart"]
    lines = [head, ["---"] * 3, *([name, every[name], some[name]] for name in every)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def answers(asked: Asked) -> Iterator[tuple[str, str]]:
    """Yield questions and answers."""
    count = dcreg.max_inliers(
        *asked.clouds, distance=DISTANCE,
        **{name: value for name, value in asked.given.items() if name != "n_inliers"},
    )  # fmt: skip
    yield f"how many pairs are within {DISTANCE:g} m?", count.answer
    chosen = replace(asked, n_inliers=None).register()
    evidence = chosen.chosen_number
    assert evidence is not None
    is_only = evidence.low == evidence.high
    near = "no other number fits" if is_only else f"{evidence.low} to {evidence.high} fit"
    yield "how many pairs does the library choose?", f"{chosen.n_inliers} ({near} nearly as well)"
    asked = replace(asked, n_inliers=asked.n_inliers or count.at_least)
    yield "number *k* of pairs in the questions below", str(asked.n_inliers)
    found = asked.register()
    yield "which pose matches *k* pairs best?", asked.described(found)
    yield "is the official pose optimal?", _certified(asked)
    others = dcreg.alternatives(*asked.clouds, **asked.given)
    yield "is the best pose the only one?", others.answer
    for most in (DISTANCE, DISTANCE / 10.0):
        met = asked.register(max_rms=most)
        answer = "yes" if met.rmse_matched <= most else "no" * (met.status == "refuted") or "open"
        yield f"do *k* pairs fit with an RMS residual of {most:g} m?", f"{answer}: `{met.status}`"
    yield from _in_ranges(asked)
    weights = dcreg.PointWeights(source=asked.distinct, distance=DISTANCE)
    weighted = asked.register(weights=weights)
    yield "which pose is best with weights for distinctive descriptors?", asked.described(weighted)
    free = asked.register("similarity3d")
    yield "which scale is best (`similarity3d`)?", f"{free.scale:.3f}; {proven(free)}"
    yield "how uncertain is the pose (standard deviations)?", _uncertainty(found)
    kept = asked.register(options=dcreg.SolveOptions(certificate=True))
    report = dcreg.verify(kept.certificate, *asked.clouds)
    bounds = f"lower bound {report.lower_bound:.4g} m², upper bound {report.upper_bound:.4g} m²"
    yield "does `verify` accept the certificate?", f"`{report.verdict}`: {bounds}"


def _certified(asked: Asked) -> str:
    """Judge the official pose."""
    judged = dcreg.certify(*asked.clouds, asked.T_official, **asked.given)
    return (
        f"`{judged.verdict}`: objective {judged.objective:.3g} m², best objective found "
        f"{judged.result.objective:.3g} m², lower bound {judged.lower_bound:.3g} m²"
    )


def _in_ranges(asked: Asked) -> Iterator[tuple[str, str]]:
    """Ask for the best pose in two ranges of poses."""
    near = dcreg.PoseRange(max_angle=20.0, around=asked.T_official)
    best = asked.register(pose_range=near)
    yield "which pose is best within 20° of the official pose?", proven(best)
    turn = asked.T_official[:3, :3]
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    known = asked.register(pose_range=dcreg.PoseRange(axis=axis))
    yield "which pose is best with the axis of the official rotation?", asked.described(known)


def proven(found: dcreg.Result) -> str:
    """Return the status, and the lower bound divided by the upper bound."""
    return f"`{found.status}`, L/U {percent(found.bound_ratio)}"


def _uncertainty(found: dcreg.Result) -> str:
    """Return the standard deviations of the pose and the number of open directions."""
    if found.covariance is None:
        return "not determined"
    sigma = np.sqrt(np.diag(found.covariance))
    turn, shift = np.degrees(sigma[:3]), sigma[3:]
    return (
        f"rotation {', '.join(f'{each:.1f}°' for each in turn)}; translation "
        f"{', '.join(f'{each:.3f}' for each in shift)} m; {len(found.open_directions or [])} open "
        "directions"
    )


if __name__ == "__main__":
    typer.run(main)
