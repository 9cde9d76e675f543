"""``python -m workflows.ablation OUT``: the bounds side by side, on the same boxes and instances.

Writes three tables to OUT.

- ``bounds.csv``: bound value against box width, over nested boxes centred on the certified optimum,
  boxes that hold it off their centre, and boxes away from it; with the least objective found in the box.
- ``orders.csv``: the empirical order of convergence, the slope of log(least - bound) against log(width).
- ``searches.csv``: the history of one search per bound and instance, nodes and assignments against gap.

Bounds are found by name in `dcreg.bounds.BOUNDS`; a new one takes part without a change here.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from data.registry import dataset
from dcreg.bounds import BOUNDS, make_bound
from dcreg.problem import Frame, Problem, default_gap_tol
from dcreg.search import Box, Limits, LongestEdge, SearchResult, branch_and_bound
from dcreg.spaces import Similarity2D
from workflows.disturb import make_instance

WIDTHS = np.geomspace(2.0, 0.0002, 17)  # of the whole box, in units of the target's RMS radius
N_FITTED = 6  # smallest widths, with a loss above this share of the optimum, that show the order
FLOOR = 1e-3
COMBINED = ("tight+edges", "paper+edges")  # in the searches
N_DRAWS = 3  # boxes per width that hold the optimum off their centre, and that lie away from it
SEED = 20260326


@dataclass(frozen=True)
class Instance:
    """A generated 2D problem, with its model in normalised coordinates."""

    name: str
    model: Similarity2D
    gap_tol: float

    @classmethod
    def of(
        cls, name: str, shape: str, test: str, level: float, n_points: int, **options: float
    ) -> Instance:
        raw = make_instance(dataset("embedded"), shape, test, level, 0, n_points, **options)
        problem = Problem(raw.source, raw.target, len(raw.pairs), "similarity2d", raw.scale_range)
        frame = Frame.of(problem)
        model = Similarity2D(
            frame.source(problem.source),
            frame.target(problem.target),
            problem.n_inliers,
            problem.scale_range,
        )
        gap_tol = default_gap_tol(problem.target, problem.n_inliers) / frame.unit**2
        return cls(name, model, gap_tol)


def instances() -> list[Instance]:
    """All points match, and with outliers in both sets; small, so that weak bounds get somewhere."""
    return [
        Instance.of("complete", "fish", "noise", 0.03, 30),
        Instance.of("outliers", "glyph", "mixed_outliers", 0.2, 20, base_deformation=0.03),
    ]


# --- one box ------------------------------------------------------------------------------------


def placements(theta: np.ndarray, width: float, rng: np.random.Generator) -> dict[str, list[Box]]:
    """Boxes of one width: where the optimum `theta` lies in them, or that it does not."""
    half = 0.5 * width
    held = [theta + rng.uniform(-half, half, 4) for _ in range(N_DRAWS)]
    # a quarter turn and some shift away; the largest boxes may reach back to the optimum
    turned = np.array([-theta[1], theta[0], theta[2] + 0.4, theta[3] - 0.4])
    away = [turned + rng.uniform(-0.2, 0.2, 4) for _ in range(N_DRAWS)]
    boxes = {
        name: [Box(centre - half, centre + half) for centre in centres]
        for name, centres in (("centred", [theta]), ("holding", held), ("away", away))
    }
    boxes["away"] = [box for box in boxes["away"] if (abs(theta - box.centre) > half).any()]
    return boxes


def bound_value(name: str, instance: Instance, box: Box) -> tuple[float, int, float]:
    """Bound, assignments and seconds, from nothing: what other boxes had solved does not help."""
    model = instance.model
    model.start_box = lambda: box  # type: ignore[method-assign]
    began = time.perf_counter()
    bound = make_bound(name, model)
    found = bound.evaluate(box.lower[None], box.upper[None], np.inf)
    del model.start_box
    return float(found.lower_bounds[0]), bound.n_assignments, time.perf_counter() - began


def least_found(instance: Instance, box: Box, rng: np.random.Generator) -> float:
    """Least objective met in the box: an upper bound on its minimum, exact where it holds the optimum."""
    model = instance.model
    thetas = np.vstack([box.centre[None], box.vertices(), box.sample(rng, 100)])
    thetas = thetas[model.admissible(thetas)]
    descents = [np.clip(model.refine(theta)[0], box.lower, box.upper) for theta in thetas[::10]]
    candidates = np.vstack([thetas, *(theta[None] for theta in descents)])
    candidates = candidates[model.admissible(candidates)]
    return min((model.objective(theta)[0] for theta in candidates), default=np.inf)


def bounds_table(instance: Instance, theta: np.ndarray) -> pd.DataFrame:
    """Every bound on every box."""
    rows = []
    for width in WIDTHS:
        rng = np.random.default_rng(SEED)  # the same directions at every width: nested boxes
        for place, boxes in placements(theta, float(width), rng).items():
            for draw, box in enumerate(boxes):
                if not instance.model.touches(box.lower[None], box.upper[None])[0]:
                    continue
                least = least_found(instance, box, np.random.default_rng(SEED))
                if place != "away":
                    least = min(least, instance.model.objective(theta)[0])
                for name in BOUNDS:
                    value, spent, seconds = bound_value(name, instance, box)
                    rows.append(
                        {
                            "instance": instance.name,
                            "place": place,
                            "draw": draw,
                            "width": float(width),
                            "bound": name,
                            "value": value,
                            "least": least,
                            "n_assignments": spent,
                            "time_s": seconds,
                        }
                    )
    return pd.DataFrame(rows)


def orders_table(bounds: pd.DataFrame) -> pd.DataFrame:
    """Slope of log loss over log width, of boxes that hold the optimum.

    Fitted to the smallest widths at which the loss still shows beside the optimum. NaN where fewer than
    three are left: a bound that loses nothing has no order.
    """
    held = bounds[bounds["place"] != "away"]
    mean = (
        held.assign(loss=held["least"] - held["value"])
        .groupby(["instance", "place", "bound", "width"], sort=False)[["loss", "least"]]
        .mean()
        .reset_index()
    )
    rows = []
    for (instance, place, name), part in mean.groupby(["instance", "place", "bound"], sort=False):
        part = part[part["loss"] > FLOOR * part["least"]].nsmallest(N_FITTED, "width")
        fitted = (
            np.polyfit(np.log(part["width"]), np.log(part["loss"]), 1)
            if len(part) > 2
            else [np.nan]
        )
        rows.append(
            {
                "instance": instance,
                "place": place,
                "bound": name,
                "order": fitted[0],
                "from_width": part["width"].min(),
                "to_width": part["width"].max(),
            }
        )
    return pd.DataFrame(rows)


# --- one search ---------------------------------------------------------------------------------


def search(name: str, instance: Instance, gap_tol: float, limits: Limits) -> SearchResult:
    """Algorithm 1 with the bound called `name`, as `dcreg.register` runs it."""
    model = instance.model
    theta, value, _ = model.first_incumbent()
    return branch_and_bound(
        make_bound(name, model),
        [model.start_box()],
        branching=LongestEdge(model.axis_weights),
        gap_tol=gap_tol,
        refine=model.refine,
        start=(theta, value),
        limits=limits,
    )


def searches_table(instance: Instance, time_s: float) -> pd.DataFrame:
    """Bound history per bound; a row per change, gaps in units of the default tolerance."""
    rows = []
    for name in [*BOUNDS, *COMBINED]:
        found = search(name, instance, 0.1 * instance.gap_tol, Limits(time_s=time_s))
        rows += [
            {
                "instance": instance.name,
                "bound": name,
                "n_nodes": event.n_nodes,
                "n_assignments": event.n_assignments,
                "time_s": event.time_s,
                "gap": event.gap / instance.gap_tol,
                "status": found.status.value,
            }
            for event in found.events
        ]
    return pd.DataFrame(rows)


def run(out: Path, time_s: float) -> None:
    """All tables, into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    bounds, searches = [], []
    for instance in instances():
        optimum = search("tight", instance, 1e-3 * instance.gap_tol, Limits())
        bounds.append(bounds_table(instance, optimum.theta))
        searches.append(searches_table(instance, time_s))
        typer.echo(f"{instance.name}: optimum {optimum.upper_bound:.6g} ({optimum.status})")
    table = pd.concat(bounds)
    table.to_csv(out / "bounds.csv", index=False)
    orders_table(table).to_csv(out / "orders.csv", index=False)
    pd.concat(searches).to_csv(out / "searches.csv", index=False)


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")] = Path("results/ablation"),
    time_s: Annotated[float, typer.Option(help="seconds per search")] = 6.0,
) -> None:
    """Compare the bounds and store the tables."""
    run(out, time_s)


if __name__ == "__main__":
    typer.run(main)
