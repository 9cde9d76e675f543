"""The commands that ask about poses: ``certify``, ``alternatives`` and ``max-inliers``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dcreg
from dcreg.cli import output
from dcreg.cli.app import command, required_count, run_search
from dcreg.cli.files import AnswerFiles, ProofFiles
from dcreg.cli.options import CloudFiles, Poses, Quiet, Search
from dcreg.cli.weights import CostFiles
from dcreg.names import DEFAULT_RATIO, DEFAULT_TIME_LIMIT_S

if TYPE_CHECKING:
    import numpy as np


@command
def certify(
    *,
    pose: str,
    clouds: CloudFiles,
    n_inliers: str | None = None,
    search: Search,
    poses: Poses,
    costs: CostFiles,
    files: ProofFiles,
    quiet: Quiet = False,
) -> int:
    """Judge a given POSE, from any program, as optimal, improvable or open.

    The answer is the objective of the pose, a lower bound on the objective of every
    pose, and a verdict. Optimal: it is proven that no pose is better by more than the
    tolerance. Improvable: a better pose was found. Open: neither.

    Exit code: 0 optimal; 2 bad input; 3 open; 4 an output file could not be written;
    6 improvable.

    Parameters
    ----------
    pose : POSE
        A matrix as text or .npy, JSON written by dcreg, or one line in KITTI or TUM format.
    n_inliers : K
        Pairs to match, as for `dcreg register`. Required.
    """
    files.check(*clouds.names.values(), search.candidates_path, poses.init, pose, *costs.paths)
    names = {**clouds.names, "pose": pose}
    count, T = required_count(n_inliers), dcreg.read_pose(pose)
    points = clouds.read(search.model)
    keywords, options = search.settings(clouds)
    keywords |= {"n_inliers": count, **costs.settings(clouds)}
    options["certificate"] = files.certificate_path is not None
    options["checkpoint"] = files.checkpoint_path
    keywords["pose_range"], init = poses.settings()
    if keywords["pose_range"] is None:
        options["init"] = init
    found = run_search(dcreg.certify, *points, T, quiet=quiet, options=options, **keywords)
    codes = {"optimal": output.EXIT_OK, "improvable": output.EXIT_REFUTED}
    code = codes.get(found.verdict, output.EXIT_LIMIT)
    proof = files.certificate_path, found.result.write_certificate
    return _finish(found, points, clouds, names, files, proof) or code


@dataclass
class Others:
    """The definition of other poses, as for `dcreg.alternatives`.

    Attributes
    ----------
    ratio : X
        A pose is nearly as good if its objective is at most X times that of the best pose.
    min_displacement : D
        Two poses are distinct if the RMS displacement of the source points between them exceeds D, in
        units of the target. Default: three times the RMS residual of the best pose or --noise, but at
        least 1 % of the RMS radius of the target.
    noise : D
        A pose is also nearly as good if its RMS residual is at most D, in units of the target; needed for
        exact fits, whose objective is 0. Default: a third of --min-displacement, but at most a third of
        1 % of the RMS radius of the target.
    isolated : D
        Replaces --min-displacement. In addition, raise the lower bound on the objective of all distinct
        poses beyond --ratio times the best objective, as far as possible within the limits.
    max_others : N
        Stop when N other poses are found.
    """

    ratio: float = DEFAULT_RATIO
    min_displacement: float | None = None
    noise: float | None = None
    isolated: float | None = None
    max_others: int = 20


@command
def alternatives(
    *,
    clouds: CloudFiles,
    n_inliers: str | None = None,
    search: Search,
    others: Others,
    files: AnswerFiles,
    quiet: Quiet = False,
) -> int:
    """Find all distinct poses that are nearly as good as the best one, or prove that there is none.

    Exit code: 0 the list is proven to be complete; 2 bad input; 3 more such
    poses may exist; 4 an output file could not be written.

    Parameters
    ----------
    n_inliers : K
        Pairs to match, as for `dcreg register`. Required.
    """
    files.check(*clouds.names.values(), search.candidates_path)
    count = required_count(n_inliers)
    points = clouds.read(search.model)
    keywords, options = search.settings(clouds)
    keywords |= {"n_inliers": count, **vars(others)}
    found = run_search(dcreg.alternatives, *points, quiet=quiet, options=options, **keywords)
    code = output.EXIT_OK if found.is_complete else output.EXIT_LIMIT
    return _finish(found, points, clouds, clouds.names, files) or code


@dataclass
class Count:
    """The settings of `dcreg.max_inliers`.

    Attributes
    ----------
    model : NAME
        Kind of pose: {models}.
    distance : D
        Maximum residual of a counted pair, in units of the target.
    scale_range : LO HI
        Admissible scales, as for `dcreg register`.
    candidates_path : FILE
        Feasible pairs, as for `dcreg register`.
    time_limit : S
        Seconds of all searches together; inf: no limit.
    threads : N
        Number of threads; default: one per processor, at most 8.
    """

    model: str
    distance: float
    scale_range: tuple[float, float] | None = None
    candidates_path: str | None = None
    time_limit: float = DEFAULT_TIME_LIMIT_S
    threads: int | None = None


@command
def max_inliers(
    *,
    clouds: CloudFiles,
    count: Count,
    poses: Poses,
    files: AnswerFiles,
    quiet: Quiet = False,
) -> int:
    """Bound the largest number of one-to-one pairs that a pose can bring within a distance.

    The lower bound is the number of pairs at the best pose found. No pose
    exceeds the upper bound. The answer says whether the search has proven this or
    whether the upper bound is only the number of points.

    Exit code: 0 the bounds agree; 2 bad input; 3 the bounds differ; 4 an
    output file could not be written.
    """
    files.check(*clouds.names.values(), count.candidates_path, poses.init)
    points = clouds.read(count.model)
    keywords = dict(vars(count))
    path, options = keywords.pop("candidates_path"), {"threads": keywords.pop("threads")}
    keywords["candidates"] = None if path is None else clouds.read_candidates(path)
    keywords["pose_range"], options["init"] = poses.settings()
    found = run_search(dcreg.max_inliers, *points, quiet=quiet, options=options, **keywords)
    code = output.EXIT_OK if found.is_exact else output.EXIT_LIMIT
    return _finish(found, points, clouds, clouds.names, files) or code


def _in_files(found: Any, clouds: CloudFiles) -> Any:
    """Return the answer with pairs that are rows of the files."""
    if isinstance(found, dcreg.MaxInliers):
        return clouds.in_files([found])[0]
    return replace(found, result=clouds.in_files([found.result])[0])


def _finish(
    found: Any,
    points: tuple[np.ndarray, np.ndarray],
    clouds: CloudFiles,
    names: dict[str, str],
    files: AnswerFiles,
    *more_files: tuple[Path | None, output.Writer],
) -> int:
    """Print an answer and write its files; return 0, or the exit code of a failure."""
    return output.write_answer(
        found, points, files.json_path, files.plot_path, {**names, **clouds.n_dropped},
        *more_files, in_files=_in_files(found, clouds),
    )  # fmt: skip
