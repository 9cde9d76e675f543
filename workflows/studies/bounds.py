"""Compare lower bounds on the same boxes and problems: ``python -m workflows.studies.bounds OUT``.

The study compares the bounds of the library (`dcreg.families.registry`) and those of every other method
that can bound a box of poses (`baselines.contract.BoxBounding`). A new bound of either kind takes part
without a change here. The study writes to OUT:

- ``boxes.csv``: the bound of every box, and the minimum objective found in it. Each trial of a case has
  one box per width, so the boxes of a width are independent. It is centred on the certified optimum,
  contains it off its centre, or does not contain it.
- ``losses.csv``: the mean of ``minimum - bound`` over the boxes of one width and place, and its ratio to
  the loss of the published DC bound.
- ``orders.csv``: the empirical order of convergence, the slope of log loss against log width.
- ``searches.csv``: gap against nodes and assignments, for the first trials of each case. There is one
  search per bound and combination of bounds of the library, and one per bound of a method that has
  several.
- ``provenance.json``: machine, commit and packages.

Coordinates are normalised: centred, with a target of RMS radius 1. In 3D the parameter is the translation
and the objective is that of point norms.
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pandas as pd
import typer

from baselines import registry
from baselines._shared.library_search import OwnBound
from baselines._shared.single_boxes import bound_of_box, box_space
from baselines.contract import BoxBounding, Instance
from data.registry import dataset
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import MakeBound
from dcreg.families.registry import make_bound
from dcreg.names import BOUND_NAMES, DEFAULT_REL_GAP
from dcreg.problem import Frame, Problem
from dcreg.search import Box, Budget, Outcome, Tolerance, minimise
from workflows import provenance
from workflows.archives import PROVENANCE
from workflows.disturb import make_instance
from workflows.studies import N_FITTED, REFERENCE, SHOWING

WIDTHS = np.geomspace(2.0, 0.0002, 13)  # of the whole box, in RMS radii of the target
PLACES = ("centred", "holding", "away")  # of boxes, by the trial
# Trials of each case, with one box per width: 144 instances. To show a share of 0.9 at every width takes
# 95 at the strictest level; large boxes cannot avoid the optimum.
TRIALS = 24
SEARCHED = 4  # trials of each case that are searched: 24 instances; a verdict needs 20
SEED = 20260326
COMBINED = ("tight+interval", "dc+interval")  # take part in the searches
CASES = {  # shape, disturbance, level, points, options of the disturbance
    "2D, all points match": ("fish", "noise", 0.03, 30, {}),
    "2D, outliers": ("glyph", "mixed_outliers", 0.2, 20, {"base_deformation": 0.03}),
    "2D, deformed": ("glyph", "deformation", 0.03, 25, {}),
    "3D norms, all points match": ("pony", "noise", 0.02, 40, {}),
    "3D norms, outliers": ("pony", "mixed_outliers", 0.3, 30, {}),
    "3D norms, deformed": ("saurian", "deformation", 0.03, 30, {}),
}


@dataclass(frozen=True)
class Case:
    """A normalised problem and the minimum of its objective."""

    instance: Instance
    space: FeatureSpace
    theta: np.ndarray
    minimum: float

    @property
    def gap_tol(self) -> float:
        """The gap that the library's default tolerance allows at the minimum."""
        return DEFAULT_REL_GAP * self.minimum

    @classmethod
    def of(cls, name: str, trial: int = 0) -> Case:
        """Solve a trial of the case `name` of `CASES` to a hundredth of the default tolerance."""
        shape, test, level, n_points, options = CASES[name]
        raw = make_instance(dataset("embedded"), shape, test, level, trial, n_points, **options)
        k = len(raw.pairs)
        model = dataset("embedded").model(shape)
        frame = Frame.of(Problem(raw.source, raw.target, k, model, raw.scale_range))
        source, target = frame.source(raw.source), frame.target(raw.target)
        instance = Instance(name, source, target, model, k, raw.scale_range, 0.1, SEED)
        space = box_space(instance)
        found = search(partial(make_bound, "tight"), space, 0.01, Budget(time_s=60.0))
        return cls(instance, space, found.theta, found.upper_bound)


# --- boxes --------------------------------------------------------------------------------------


def placement(name: str, theta: np.ndarray, width: float, trial: int) -> tuple[str, Box] | None:
    """Return place and box of a trial of a case; None if it should avoid the optimum `theta` and cannot.

    The draw does not depend on the width.
    """
    rng = np.random.default_rng([SEED, zlib.crc32(name.encode()), trial])
    place = PLACES[trial % len(PLACES)]
    half, centre = 0.5 * width, theta
    if place == "holding":
        centre = theta + half * rng.uniform(-1.0, 1.0, theta.size)
    elif place == "away":
        if theta.size == 4:  # a quarter turn and a shift
            centre = np.array([-theta[1], theta[0], theta[2] + 0.4, theta[3] - 0.4])
        else:
            centre = theta + np.array([0.6, -0.5, 0.6])
        centre = centre + rng.uniform(-0.2, 0.2, theta.size)
        if (abs(theta - centre) <= half).all():
            return None
    return place, Box(centre - half, centre + half)


def minimum_found(case: Case, box: Box) -> float:
    """Return the minimum objective found in the box, which is exact if the box contains the optimum."""
    space = case.space
    thetas = np.vstack([box.centre, box.vertices(), box.sample(np.random.default_rng(SEED), 60)])
    descents = [np.clip(space.refine(theta)[0], box.lower, box.upper) for theta in thetas[:10]]
    thetas = np.vstack([thetas, descents])
    if ((box.lower <= case.theta) & (case.theta <= box.upper)).all():
        thetas = np.vstack([thetas, case.theta])
    admissible = thetas[space.admissible(thetas)]
    return min((space.objective(theta)[0] for theta in admissible), default=np.inf)


# --- bounds -------------------------------------------------------------------------------------

# Case and box -> lower bound (NaN where a method has none) and assignments solved (NaN: not counted)
BoundBox = Callable[[Case, Box], tuple[float, float]]


class Line(NamedTuple):
    """One line of the figures: a bound of the library, or the bound of a method."""

    name: str
    bound: BoundBox


def library_bound(name: str, case: Case, box: Box) -> tuple[float, float]:
    """Return the bound called `name`, and the number of assignments solved for it."""
    return bound_of_box(partial(make_bound, name), case.space, box)


def method_bound(method: BoxBounding, case: Case, box: Box) -> tuple[float, float]:
    """Return the bound of a method; its assignments are not counted."""
    return float(method.box_bound(case.instance, box.lower, box.upper)), np.nan


def methods(instance: Instance) -> Iterator[tuple[str, BoxBounding]]:
    """Yield each method that bounds boxes with its name, or once per bound with the bound's name."""
    for name in (row["name"] for row in registry.availability() if row["available"]):
        bounds = getattr(registry.load(name), "bounds", ())
        for label, options in [(bound, {"bound": bound}) for bound in bounds] or [(name, {})]:
            method = registry.load(name, **options)
            if (
                isinstance(method, BoxBounding)
                and method.available() is None
                and method.supports(instance) is None
            ):
                yield label, method


def lines(case: Case) -> Iterator[Line]:
    """Yield all bounds."""
    for name in BOUND_NAMES:
        yield Line(name, partial(library_bound, name))
    for name, method in methods(case.instance):
        yield Line(name, partial(method_bound, method))


def boxes_table(name: str, trial: int, case: Case) -> pd.DataFrame:
    """Evaluate every bound on the boxes of one trial that contain an admissible pose."""
    compared = list(lines(case))
    rows = []
    for width in map(float, WIDTHS):
        if (found := placement(name, case.theta, width, trial)) is None:
            continue
        place, box = found
        minimum = minimum_found(case, box)
        if not np.isfinite(minimum):
            continue
        for line in compared:
            began = time.perf_counter()
            value, spent = line.bound(case, box)
            rows.append(
                {
                    "instance": name, "trial": trial, "place": place, "width": width,
                    "bound": line.name, "value": value, "minimum": minimum,
                    "n_assignments": spent, "time_s": time.perf_counter() - began,
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def losses_table(boxes: pd.DataFrame) -> pd.DataFrame:
    """Return the mean loss per bound, place and width, and its ratio to the loss of `REFERENCE`."""
    axes = ["instance", "place", "width"]
    mean = (
        boxes.assign(loss=boxes["minimum"] - boxes["value"])
        .groupby([*axes, "bound"], sort=False)[["value", "minimum", "loss"]]
        .mean()
        .reset_index()
    )
    reference = mean[mean["bound"] == REFERENCE].set_index(axes)["loss"].rename("reference")
    mean = mean.join(reference, on=axes)
    return mean.assign(ratio=mean["loss"] / mean["reference"]).drop(columns="reference")


def orders_table(losses: pd.DataFrame) -> pd.DataFrame:
    """Return the slope of log loss over log width for boxes that contain the optimum.

    It is NaN if fewer than three widths show a loss: an exact bound has no order.
    """
    held = losses[losses["place"] != "away"]
    rows = []
    for (instance, place, name), part in held.groupby(["instance", "place", "bound"], sort=False):
        part = part[part["loss"] > SHOWING * part["minimum"]].nsmallest(N_FITTED, "width")
        order = np.nan
        if len(part) > 2:
            order = float(np.polyfit(np.log(part["width"]), np.log(part["loss"]), 1)[0])
        rows.append(
            {
                "instance": instance, "place": place, "bound": name, "order": order,
                "from_width": part["width"].min(), "to_width": part["width"].max(),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


# --- searches -----------------------------------------------------------------------------------


def search(make: MakeBound, space: FeatureSpace, share: float, budget: Budget) -> Outcome:
    """Run branch and bound with the bound, to a share of the library's default tolerance."""
    return minimise(space, make(space), budget, tolerance=Tolerance(share * DEFAULT_REL_GAP))


def searched(case: Case) -> dict[str, MakeBound]:
    """Return the bounds to search with: those of the library, and of methods with several."""
    makers: dict[str, MakeBound] = {
        name: partial(make_bound, name) for name in (*BOUND_NAMES, *COMBINED)
    }
    for name, method in methods(case.instance):
        if isinstance(method, OwnBound) and method.bounds:
            makers[name] = method.make_bound
    return makers


def searches_table(name: str, trial: int, case: Case, time_s: float) -> pd.DataFrame:
    """Return the bound history of each search, a row per change, with gaps in default tolerances."""
    rows = []
    for bound, make in searched(case).items():
        found = search(make, case.space, 0.1, Budget(time_s=time_s))
        rows += [
            {
                "instance": name, "trial": trial, "bound": bound, "n_nodes": event.n_nodes,
                "n_assignments": event.n_assignments, "time_s": event.time_s,
                "gap": event.gap / case.gap_tol, "status": found.status.value,
            }
            for event in found.events
        ]  # fmt: skip
    return pd.DataFrame(rows)


def run(out: Path, time_s: float) -> None:
    """Write all tables to `out`."""
    boxes, searches = [], []
    for name in CASES:
        for trial in range(TRIALS):
            case = Case.of(name, trial)
            boxes.append(boxes_table(name, trial, case))
            if trial < SEARCHED:
                searches.append(searches_table(name, trial, case, time_s))
        typer.echo(f"{name}: {TRIALS} instances, {SEARCHED} of them searched with every bound")
    table = pd.concat(boxes)
    losses = losses_table(table)
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "boxes.csv", index=False)
    losses.to_csv(out / "losses.csv", index=False)
    orders_table(losses).to_csv(out / "orders.csv", index=False)
    pd.concat(searches).to_csv(out / "searches.csv", index=False)
    (out / PROVENANCE).write_text(
        json.dumps({"time_s": time_s, **provenance.origin()}, indent=1) + "\n"
    )


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")] = Path("results/bounds"),
    time_s: Annotated[float, typer.Option(help="seconds per search")] = 6.0,
) -> None:
    """Compare the bounds and store the tables."""
    run(out, time_s)


if __name__ == "__main__":
    typer.run(main)
