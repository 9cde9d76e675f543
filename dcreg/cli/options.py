"""Arguments and options of the commands, and the conversion of their text.

Each dataclass is a group of parameters that several commands share. `dcreg.cli.commands` turns every
field into an argument or option.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import dcreg
from dcreg.names import (
    AUTO,
    DEFAULT_TIME_LIMIT_S,
    MODEL_DIM,
    SCORES,
    START_BOXES,
    bound_names,
    mode_names,
)

if TYPE_CHECKING:  # NumPy is loaded with the first file, not for --help
    import numpy as np

MAX_CARDINALITIES = 1000  # of one range of a sweep


# --- numbers ------------------------------------------------------------------------------------------


# Typer's own conversions name the option but not the value.
def number(text: str) -> float:
    """Return a number, or raise an error that shows the text."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a number; give one such as 0.5") from None


def whole_number(text: str) -> int:
    """Return a whole number, or raise an error that shows the text."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a whole number; give one such as 4") from None


def parse_count(text: str) -> int | float:
    """Return `--n-inliers`: an integer is a number of pairs, a decimal point makes it a fraction."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    raise dcreg.InputError(
        f"--n-inliers: '{text}' is not a number; give a count such as 40 or a fraction such as 0.8"
    )


def parse_counts(text: str) -> list[int | float]:
    """Return `--n-inliers` of a sweep: numbers and ranges ``FROM:TO:STEP``, separated by commas."""
    counts: list[int | float] = []
    for part in filter(None, (part.strip() for part in text.split(","))):
        counts += _range(part) if ":" in part else [parse_count(part)]
    return counts


def _range(text: str) -> list[int | float]:
    first, last, *rest = ends = [parse_count(number) for number in text.split(":")]
    if len({type(number) for number in ends}) > 1:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' mixes counts and fractions; a fraction needs a decimal point, "
            "as in 0.3:1.0:0.1"
        )
    if not rest and isinstance(first, int):
        rest = [1]
    if len(rest) != 1 or not all(map(math.isfinite, ends)) or rest[0] <= 0 or first > last:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' is not a range FROM:TO:STEP with FROM <= TO and STEP > 0; "
            "give one such as 0.3:1.0:0.1 or 20:60:5"
        )
    step = rest[0]
    n_steps = math.floor((last - first) / step + 1e-9)  # 0.7 / 0.1 is slightly less than 7
    if n_steps >= MAX_CARDINALITIES:
        raise dcreg.InputError(
            f"--n-inliers: '{text}' is a range of {n_steps + 1} numbers; choose a step that leaves at "
            f"most {MAX_CARDINALITIES}"
        )
    return [round(first + at * step, 12) for at in range(n_steps + 1)]


# --- groups of options --------------------------------------------------------------------------------

_NUMBER: dict[str, Any] = {"metavar": "X", "parser": number}
_COUNT: dict[str, Any] = {"metavar": "N", "parser": whole_number}
GapTol = Annotated[
    float | None,
    typer.Option(
        help="Absolute gap to close, in squared units of the target. Default: K * (0.03 * RMS radius of "
        "the target)^2, with 0.003 instead of 0.03 for bounds in norm space.",
        **_NUMBER,
    ),
]
TimeLimit = Annotated[
    float, typer.Option(metavar="S", parser=number, help="Seconds of search; inf: no limit.")
]
NodeLimit = Annotated[
    int | None,
    typer.Option(
        help="Maximum number of boxes in each search; the batch in progress is completed.", **_COUNT
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress and no hints.")]


@dataclass
class Clouds:
    """The two files of points."""

    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Cloud that moves: FILE or FILE.npz:KEY.")
    ]
    target: Annotated[
        str,
        typer.Argument(metavar="TARGET", help="Cloud that stays; results are in its units."),
    ]
    source_key: Annotated[
        str | None, typer.Option(metavar="KEY", help="Array of an .npz or .mat source.")
    ] = None
    target_key: Annotated[
        str | None, typer.Option(metavar="KEY", help="Array of an .npz or .mat target.")
    ] = None

    @property
    def names(self) -> dict[str, str]:
        """The files as they were given."""
        return {"source": self.source, "target": self.target}

    def read(self, model: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of both files; refuse points that do not have the dimension of `model`."""
        files = ((self.source, self.source_key), (self.target, self.target_key))
        clouds = []
        for path, key in files:
            points = dcreg.read_points(path, key=key)
            found = points.shape[1]
            if found != (needed := MODEL_DIM.get(model or "", found)):
                fitting = next(name for name, dim in MODEL_DIM.items() if dim == found)
                raise dcreg.InputError(
                    f"{path}: points have {found} coordinates, but --model {model} needs {needed}; "
                    f"use --model {fitting} or another file"
                )
            clouds.append(points)
        return clouds[0], clouds[1]


@dataclass
class Search:
    """The problem and its search: the settings of `dcreg.register` and `dcreg.sweep`."""

    model: Annotated[
        str, typer.Option(metavar="NAME", help=f"Kind of pose: {' or '.join(MODEL_DIM)}.")
    ]
    scale_range: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="LO HI",
            parser=number,
            help="Admissible scales (2D only; default 0.5 1.5). Equal numbers fix the scale: 1 1 "
            "searches rotation and translation only.",
        ),
    ] = None
    candidates_path: Annotated[
        str | None,
        typer.Option(
            "--candidates",
            metavar="FILE",
            help="Feasible pairs: two columns, source row and target row, from 0. Default: all pairs.",
        ),
    ] = None
    mode: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Search mode. In 2D: {', '.join(mode_names('similarity2d'))}. In 3D: "
            f"{', '.join(mode_names('rigid3d'))}. Default: {AUTO}, which in 3D selects full, or "
            "paper if a bound or a certificate is requested or too many pairs are searched.",
        ),
    ] = None
    bound: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Lower bounding function: {', '.join(bound_names())}; 'a+b' takes the maximum of two.",
        ),
    ] = None
    start_box: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help=f"Box where the search starts: {' or '.join(START_BOXES)}. Both contain every optimum; "
            "radius is larger.",
        ),
    ] = START_BOXES[0]
    gap_tol: GapTol = None
    tol: Annotated[
        float | None,
        typer.Option(
            help="Gap as an RMS residual per pair, in units of the target: --tol 0.01 is --gap-tol "
            "K * 0.01^2.",
            **_NUMBER,
        ),
    ] = None
    time_limit: TimeLimit = DEFAULT_TIME_LIMIT_S
    node_limit: NodeLimit = None
    memory_limit_mb: Annotated[
        float | None,
        typer.Option(
            metavar="MB",
            parser=number,
            help="Maximum memory of the open boxes of a search. Default: no limit.",
        ),
    ] = None
    threads: Annotated[
        int, typer.Option(help="Number of threads; the result does not depend on it.", **_COUNT)
    ] = 1
    polish: Annotated[
        bool, typer.Option(help="Refine pose and pairs jointly after the certified search.")
    ] = True
    downsample: Annotated[
        int | None,
        typer.Option(
            help="Search with at most N points of each cloud (farthest-point sampling after outlier "
            "removal), then refine the pose on all points.",
            **_COUNT,
        ),
    ] = None

    def settings(self, n_source: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the keywords of the library's functions and those of `dcreg.SolveOptions`."""
        names = ("mode", "bound", "start_box", "threads", "polish", "downsample")
        options = {name: getattr(self, name) for name in names}
        keywords = {name: value for name, value in vars(self).items() if name not in names}
        path = keywords.pop("candidates_path")
        keywords["candidates"] = None if path is None else dcreg.read_candidates(path, n_source)
        return keywords, options


@dataclass
class MatchSearch:
    """The search over matches: the settings of `dcreg.register_matches`."""

    inlier_distance: Annotated[
        float,
        typer.Option(
            metavar="D",
            parser=number,
            help="Residual above which a match counts as wrong, in units of the target.",
        ),
    ]
    score: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Criterion for the pose: 'correspondences' is the cost of the matches; 'surfaces' "
            "also compares the surfaces of dense scans and gives no bounds.",
        ),
    ] = SCORES[0]
    certify: Annotated[
        bool | None,
        typer.Option(
            help="Prove bounds by branch and bound. Default: only with --score correspondences."
        ),
    ] = None
    gap_tol: Annotated[
        float | None,
        typer.Option(
            help="Absolute gap to close, in squared units of the target. Default: D^2 / 10 for each "
            "match that the initial pose selects.",
            **_NUMBER,
        ),
    ] = None
    time_limit: TimeLimit = DEFAULT_TIME_LIMIT_S
    node_limit: NodeLimit = None


@dataclass
class Outputs:
    """The files of one registration."""

    json_path: Annotated[
        Path | None,
        typer.Option("--json", metavar="OUT", help="Write the result; '-' is standard output."),
    ] = None
    trace_path: Annotated[
        Path | None, typer.Option("--trace", metavar="OUT.jsonl", help="Write the bound history.")
    ] = None
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.html", help="Write a page with figures.")
    ] = None

    @property
    def paths(self) -> dict[str, Path | None]:
        """The file of each option."""
        return {"--json": self.json_path, "--trace": self.trace_path, "--plot": self.plot_path}
