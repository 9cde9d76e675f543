"""Arguments and options of the commands, and the conversion of their text.

Each dataclass is a group of parameters that several commands share. Its docstring gives the placeholder
and the help of each one, as the docstring of a command does for its own parameters.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args, get_type_hints

import typer

import dcreg
from dcreg.cli.numbers import number, parse_axis, whole_number
from dcreg.names import (
    AUTO,
    CLOUD_SUFFIXES,
    DEFAULT_REL_GAP,
    DEFAULT_TIME_LIMIT_S,
    MODEL_DIM,
    SCORES,
    START_BOXES,
    bound_names,
    mode_names,
)

if TYPE_CHECKING:  # NumPy is loaded with the first file, not for --help
    import numpy as np

    from dcreg.cli.rows import CloudRows

# --- from docstrings to options -----------------------------------------------------------------------

# all other parameters are options
ARGUMENTS = "certificate", "pose", "source", "target", "matches", "pairs"
PARSERS = {float: number, int: whole_number}
# What the help texts name.
NAMES = {
    "auto": AUTO,
    "bounds": ", ".join(bound_names()),
    "cloud_suffixes": " ".join(CLOUD_SUFFIXES),
    "models": ", ".join(MODEL_DIM),
    "modes_2d": ", ".join(mode_names("similarity2d")),
    "modes_3d": ", ".join(mode_names("rigid3d")),
    "start_boxes": " or ".join(START_BOXES),
}
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress and no hints.")]


def flag(name: str) -> str:
    """Return the option of a parameter, such as ``--json`` of `json_path`."""
    return f"--{name.removesuffix('_path').replace('_', '-')}"


def with_options(message: str, options: dict[str, str]) -> str:
    """Return a message of the library, which names arguments, with the options instead.

    It begins with the name of an argument. Further on, names are recognised by an underscore, or as what
    to omit.
    """
    name, colon, rest = message.partition(":")
    for each, option in options.items():
        before = r"(?<![\w./'\"-])" if "_" in each else r"(?<=\bomit )"
        rest = re.sub(rf"{before}{each}(?![\w./='\"(])", option, rest)
    return f"{options.get(name, name)}{colon}{rest}"


def parameters_of(owner: Any) -> Iterator[inspect.Parameter]:
    """Yield the parameters of a command or a group, annotated for Typer; a group gives its fields."""
    owners = reversed(inspect.getmro(owner)) if inspect.isclass(owner) else [owner]
    text = "\n\n".join(inspect.getdoc(each) or "" for each in owners)
    entries = re.findall(r"^(\w+) : (.*)((?:\n    .*)+)", text, re.M)
    described = {name: (metavar, " ".join(text.split())) for name, metavar, text in entries}
    kinds: dict[str, Any] = get_type_hints(owner, include_extras=True)
    for each in inspect.signature(owner).parameters.values():
        kind = kinds[each.name]
        if is_dataclass(kind):
            yield from parameters_of(kind)
            continue
        if not hasattr(kind, "__metadata__"):  # python -OO removes docstrings
            kind = Annotated[kind, _info(each.name, kind, *described.get(each.name, (None, "")))]
        yield each.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY)


def _info(name: str, kind: Any, metavar: str | None, text: str) -> Any:
    """Return the argument or option of a parameter."""
    if name in ARGUMENTS:
        return typer.Argument(metavar=metavar, help=text)
    while get_args(kind):  # float of tuple[float, float] | None
        kind = get_args(kind)[0]
    is_switch = kind is bool  # Typer finds its names
    return typer.Option(
        *([] if is_switch else [flag(name)]),
        metavar=None if is_switch else metavar,
        parser=PARSERS.get(kind),
        help=text.format(**NAMES),
    )


# --- groups of options --------------------------------------------------------------------------------


@dataclass
class CloudFiles:
    """The two files of points.

    Attributes
    ----------
    source : SOURCE
        Cloud that moves: FILE or FILE:KEY.
    target : TARGET
        Cloud that stays; results are in its units.
    source_key : KEY
        Array of an .npz or .mat source, or scan of an .e57 source, from 0.
    target_key : KEY
        Array of an .npz or .mat target, or scan of an .e57 target, from 0.
    drop_invalid : switch
        Ignore points with NaN or infinity; by default, they are an error. Row numbers still refer to the
        files, fractions to the remaining points.
    """

    source: str
    target: str
    source_key: str | None = None
    target_key: str | None = None
    drop_invalid: bool = False

    def __post_init__(self) -> None:
        self.rows: CloudRows | None = None  # with --drop-invalid, once the files are read
        self.sizes = 0, 0

    @property
    def names(self) -> dict[str, str]:
        """The files as they were given."""
        return {"source": self.source, "target": self.target}

    @property
    def n_dropped(self) -> dict[str, int]:
        """Numbers of points that are dropped; empty without --drop-invalid."""
        return {} if self.rows is None else self.rows.n_dropped

    def read(self, model: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of both files; refuse points that do not have the dimension of `model`."""
        files = ((self.source, self.source_key), (self.target, self.target_key))
        clouds = []
        for path, key in files:
            points = dcreg.read_points(path, key=key, keep_invalid=self.drop_invalid)
            found = points.shape[1]
            if found != (needed := MODEL_DIM.get(model or "", found)):
                fitting = next(name for name, dim in MODEL_DIM.items() if dim == found)
                raise dcreg.InputError(
                    f"{path}: points have {found} coordinates, but model {model} needs {needed}; "
                    f"give another file, or --model {fitting}"
                )
            clouds.append(points)
        source, target = clouds
        self.sizes = len(source), len(target)
        if self.drop_invalid:
            from dcreg.cli.rows import CloudRows

            self.rows = CloudRows.of(source, target, names=self.names)
            return self.rows.valid(source, target)
        return source, target

    def read_candidates(self, path: str) -> list[list[int]]:
        """Return the feasible pairs of a file for the points that `read` returned."""
        return (self.rows or dcreg).read_candidates(path, self.sizes[0])

    def read_matches(self, path: str) -> np.ndarray:
        """Return the matches of a file for the points that `read` returned."""
        return (self.rows or dcreg).read_matches(path, *self.sizes)

    def in_files(self, results: list[Any]) -> list[Any]:
        """Return results whose pairs are rows of the files."""
        return results if self.rows is None else self.rows.in_files(results)


@dataclass
class Goal:
    """What a registration is to find.

    Attributes
    ----------
    n_inliers : K
        Pairs to match: a count, or a fraction of the smaller cloud such as 0.8. A decimal point makes it
        a fraction: '1' is one pair, '1.0' all points of the smaller cloud. By default, the library
        chooses the number, and the result states the evidence; some options need a number.
    max_rms : D
        Only decide whether some pose matches K pairs with at most this RMS residual, in units of the
        target.
    """

    n_inliers: str = AUTO
    max_rms: float | None = None


@dataclass
class Search:
    """The problem and its search: the settings of `dcreg.register` and `dcreg.sweep`.

    Attributes
    ----------
    model : NAME
        Kind of pose: {models}.
    scale_range : LO HI
        Admissible scales of a similarity (default 0.5 1.5). Equal numbers fix the scale: 1 1 searches
        rotation and translation only.
    candidates_path : FILE
        File of feasible pairs: two columns, source row and target row, counted from 0. Default: all pairs
        are feasible.
    mode : NAME
        Search mode. In 2D: {modes_2d}. In 3D: {modes_3d}; similarity3d only has full. Default: {auto},
        which selects full in 3D. For rigid3d it selects paper instead if --bound is given, if more than
        4,000,000 point pairs are searched without a sample, or for a certificate of more than 160,000
        point pairs.
    bound : NAME
        Bounding function, which computes the lower bounds: {bounds}; 'a+b' takes the maximum of two.
        A bound that is given works alone, without the stage 'distances'. In 3D it selects mode paper,
        whose bounds do not concern the pose.
    start_box : NAME
        Box in which the search starts: {start_boxes}. Both contain every optimum; radius is larger.
    rel_gap : X
        Gap at which to stop, as a share of the upper bound.
    abs_gap : X
        Absolute gap, in squared units of the target; the search stops at the larger of both gaps.
        Default: the rounding error of the objective.
    tol : X
        Absolute gap as an RMS residual per pair, in units of the target: --tol 0.01 is --abs-gap
        K * 0.01^2.
    time_limit : S
        Seconds of search; inf: no limit.
    node_limit : N
        Maximum number of boxes of each search; the last round of boxes may exceed it.
    memory_limit_mb : MB
        Maximum memory of the open boxes of a search; while their storage is enlarged, it can take up to
        three times as much. Default: no limit.
    threads : N
        Number of threads; default: one per processor, at most 8. It affects the result only if elapsed
        time ends a step of the search.
    polish : switch
        Refine pose and pairs jointly after the certified search.
    prove : switch
        Continue to the limits in search of a proof. By default, a search in mode full, or of a sample,
        ends within a few seconds if no proof is found or expected. Sweeps over all points, and searches
        with --node-limit, always continue to their limits.
    downsample : N
        Search a sample of at most N points of each cloud (farthest-point sampling after outlier removal),
        then refine the pose on all points.
    """

    model: str
    scale_range: tuple[float, float] | None = None
    candidates_path: str | None = None
    mode: str | None = None
    bound: str | None = None
    start_box: str = START_BOXES[0]
    rel_gap: float = DEFAULT_REL_GAP
    abs_gap: float | None = None
    tol: float | None = None
    time_limit: float = DEFAULT_TIME_LIMIT_S
    node_limit: int | None = None
    memory_limit_mb: float | None = None
    threads: int | None = None
    polish: bool = True
    prove: bool = False
    downsample: int | None = None

    def settings(self, clouds: CloudFiles) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the keywords of the library's functions and those of `dcreg.SolveOptions`.

        The files of `clouds` have been read.
        """
        names = ("mode", "bound", "start_box", "threads", "polish", "prove", "downsample")
        options = {name: getattr(self, name) for name in names}
        keywords = {name: value for name, value in vars(self).items() if name not in names}
        path = keywords.pop("candidates_path")
        keywords["candidates"] = None if path is None else clouds.read_candidates(path)
        return keywords, options


@dataclass
class Poses:
    """The admissible poses: those of the model, or a range around an initial guess.

    Attributes
    ----------
    init : POSE
        Initial pose: a matrix as text or .npy, JSON written by dcreg, or one line in KITTI or TUM format.
        --axis, --max-angle, --max-translation and --no-rotation refer to it. Without any of these, it
        only adds a pose from which the search starts, and certify rejects it.
    axis : X,Y,Z
        Only rotations about this axis (3D), in coordinates of the target: 0,0,1 for level scans.
    max_angle : DEG
        Maximum angle of the rotation, relative to that of --init if it is given.
    max_translation : D
        Maximum displacement of the centroid of the source, in units of the target. It is measured from
        the position at --init or, without --init, from the position in the file.
    rotation : switch
        Search rotations and translations, or only translations.
    """

    LIMITS: ClassVar = {
        "axis": "--axis", "max_angle": "--max-angle", "max_translation": "--max-translation",
        "rotation": "--no-rotation",
    }  # fmt: skip

    init: str | None = None
    axis: str | None = None
    max_angle: float = 180.0
    max_translation: float = math.inf
    rotation: bool = True

    @property
    def limits(self) -> str:
        """The options that restrict the poses, if any is given, for messages."""
        changed = [name for name in self.LIMITS if getattr(self, name) != getattr(Poses, name)]
        return " and ".join(self.LIMITS[name] for name in changed)

    @property
    def names(self) -> dict[str, str]:
        """The options that give the argument `pose_range` and its field `around`, for messages."""
        return {"pose_range": self.limits, "around": "--init"} if self.limits else {}

    def settings(self) -> tuple[dcreg.PoseRange | None, np.ndarray | None]:
        """Return the range of poses, if it is restricted, and the initial guess."""
        init = None if self.init is None else dcreg.read_pose(self.init)
        if not self.rotation and (self.axis is not None or self.max_angle != 180.0):
            raise dcreg.InputError(
                "--no-rotation: excludes --axis and --max-angle; omit them, or --no-rotation"
            )
        given = dcreg.PoseRange(
            None if self.axis is None else parse_axis(self.axis),
            self.max_angle if self.rotation else 0.0, self.max_translation, init,
        )  # fmt: skip
        is_free = given.axis is None and given.max_angle == 180.0
        return None if is_free and math.isinf(given.max_translation) else given, init


@dataclass
class MatchSearch:
    """The search over matches: the settings of `dcreg.register_matches`.

    Attributes
    ----------
    inlier_distance : D
        Matches with a residual above this distance count as wrong; in units of the target.
    score : NAME
        Criterion for the best pose: 'correspondences' is the cost of the matches; 'surfaces' also
        compares the surfaces of dense scans, without bounds.
    certify : switch
        Like --prove of register: search to the time limit for a proof. By default, the search ends after
        about five seconds, or 25 if another pose has nearly the same score. With --score surfaces, there
        is no search by default.
    rel_gap : X
        Gap at which to stop, as a share of the upper bound.
    abs_gap : X
        Absolute gap, in squared units of the target; the search stops at the larger of both gaps.
        Default: the rounding error of the cost.
    time_limit : S
        Seconds of search; inf: no limit.
    node_limit : N
        Maximum number of boxes of each search; the last round of boxes may exceed it.
    """

    inlier_distance: float
    score: str = SCORES[0]
    certify: bool | None = None
    rel_gap: float = DEFAULT_REL_GAP
    abs_gap: float | None = None
    time_limit: float = DEFAULT_TIME_LIMIT_S
    node_limit: int | None = None
