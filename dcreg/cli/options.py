"""Arguments and options that several commands have."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from dcreg.names import AUTO, MODEL_DIM, bound_names, mode_names


class ModelChoice(StrEnum):
    """Kinds of pose."""

    SIMILARITY2D = "similarity2d"
    RIGID3D = "rigid3d"


# Typer's own conversions name the option but not the value.
def number(text: str) -> float:
    """A number, or an error that shows what was given."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a number; give one such as 0.5") from None


def whole_number(text: str) -> int:
    """A whole number, or an error that shows what was given."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not a whole number; give one such as 4") from None


SourceArgument = Annotated[
    str, typer.Argument(metavar="SOURCE", help="Cloud to move; FILE or FILE.npz:KEY.")
]
TargetArgument = Annotated[
    str,
    typer.Argument(metavar="TARGET", help="Cloud that stays; its units are used throughout."),
]
ModelOption = Annotated[
    ModelChoice, typer.Option(metavar="NAME", help=f"Kind of pose: {' or '.join(MODEL_DIM)}.")
]
ScaleRangeOption = Annotated[
    tuple[float, float] | None,
    typer.Option(
        metavar="LO HI",
        parser=number,
        help="Admissible scale (2D only; default 0.5 1.5). Equal numbers fix it: 1 1 searches "
        "rotation and translation alone.",
    ),
]
ModeOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"Search mode; default: {AUTO}. In 2D {', '.join(mode_names('similarity2d'))}; in 3D one of "
        f"{', '.join(mode_names('rigid3d'))}: {AUTO} takes full, and paper for large clouds and where a "
        "bound or a certificate is asked for.",
    ),
]
BoundOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"Lower bounding function: {', '.join(bound_names())}; 'a+b' takes the greater.",
    ),
]
GapTolOption = Annotated[
    float | None,
    typer.Option(
        metavar="X",
        parser=number,
        help="Absolute gap to close, in the objective's units (sum of squared residuals of the "
        "K pairs). Default: K * (0.03 * RMS radius of the target)^2; 0.003 where norms are bounded.",
    ),
]
TolOption = Annotated[
    float | None,
    typer.Option(
        metavar="X",
        parser=number,
        help="The same as a length in units of the target, per pair: --tol 0.01 is --gap-tol K * 0.01^2.",
    ),
]
TimeLimitOption = Annotated[
    float, typer.Option(metavar="S", parser=number, help="Seconds of search; inf: no limit.")
]
NodeLimitOption = Annotated[
    int | None,
    typer.Option(metavar="N", parser=whole_number, help="Boxes to bound; a round begun is ended."),
]
ThreadsOption = Annotated[int, typer.Option(metavar="N", parser=whole_number, help="Threads.")]
PolishOption = Annotated[
    bool, typer.Option(help="Refine pose and pairs jointly after the certified search.")
]
DownsampleOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        parser=whole_number,
        help="Search with N points of each cloud at most, farthest but for stray ones; refine on all.",
    ),
]
CandidatesOption = Annotated[
    str | None,
    typer.Option(
        "--candidates",
        metavar="FILE",
        help="Feasible pairs: two columns, source row and target row, from 0. Default: all.",
    ),
]
SourceKeyOption = Annotated[
    str | None, typer.Option(metavar="KEY", help="Array of an .npz or .mat source.")
]
TargetKeyOption = Annotated[
    str | None, typer.Option(metavar="KEY", help="Array of an .npz or .mat target.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no advice.")]
JsonOption = Annotated[
    Path | None,
    typer.Option("--json", metavar="OUT", help="Write the result; '-' is standard output."),
]
TraceOption = Annotated[
    Path | None, typer.Option("--trace", metavar="OUT.jsonl", help="Write the bound history.")
]
PageOption = Annotated[
    Path | None, typer.Option("--plot", metavar="OUT.html", help="Write a page with figures.")
]
