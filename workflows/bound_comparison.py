"""``python -m workflows.bound_comparison OUT``: every method's bound and the DC bound, on the same boxes.

Methods take part by being able to bound a box of poses (`baselines.contract.BoxBounding`); none is named
here but those of which several settings are shown. Writes to OUT

- ``boxes.csv``: a row per instance, box and method: the bound, and the least objective met in the box;
- ``summary.csv``: what a bound loses to that objective, as a multiple of the published DC bound's loss;
- ``bounds.svg`` and ``bounds.png``: loss against box width.

All instances are centred, the RMS radius of the target is 1. In 3D the boxes are of translations and the
objective is that of point norms.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from baselines import registry
from baselines._shared.single_boxes import box_space
from baselines.contract import Baseline, BoxBounding, Instance
from data.registry import dataset
from dcreg.bounds import make_bound
from dcreg.problem import Frame, Problem, default_gap_tol
from dcreg.search import Box, Limits, LongestEdge, branch_and_bound
from dcreg.spaces import Space
from workflows.disturb import make_instance

WIDTHS = np.geomspace(2.0, 0.002, 7)  # of the whole box, in RMS radii of the target
N_DRAWS = 2  # boxes per width and place
SEED = 20260326
REFERENCE = ("dcreg", "paper")  # what the losses are measured by
SETTINGS: dict[str, list[dict[str, Any]]] = {
    "dcreg": [{"bound": name} for name in ("paper", "tight", "edges")],
    "rpm_htb": [{"bound": name} for name in ("termwise-r1", "termwise-r2", "termwise-r3")],
}
CASES = {  # shape, disturbance, level, points, options of the disturbance
    "2D, all points match": ("fish", "noise", 0.03, 30, {}),
    "2D, outliers": ("glyph", "mixed_outliers", 0.2, 20, {"base_deformation": 0.03}),
    "3D norms, all points match": ("pony", "noise", 0.02, 40, {}),
    "3D norms, outliers": ("pony", "mixed_outliers", 0.3, 30, {}),
}


@dataclass(frozen=True)
class Case:
    """A normalised instance and the optimum of its objective."""

    instance: Instance
    model: Space
    theta: np.ndarray
    least: float

    @classmethod
    def of(cls, name: str) -> Case:
        shape, test, level, n_points, options = CASES[name]
        raw = make_instance(dataset("embedded"), shape, test, level, 0, n_points, **options)
        k = len(raw.pairs)
        kind = "similarity2d" if raw.source.shape[1] == 2 else "rigid3d"
        frame = Frame.of(Problem(raw.source, raw.target, k, kind, raw.scale_range))
        source, target = frame.source(raw.source), frame.target(raw.target)
        instance = Instance(name, source, target, kind, k, raw.scale_range, 0.1, SEED)
        model = box_space(instance)
        theta, value, _ = model.first_incumbent()
        found = branch_and_bound(
            make_bound("tight", model),
            [model.start_box()],
            branching=LongestEdge(model.axis_weights),
            gap_tol=0.1 * default_gap_tol(target, k),
            refine=model.refine,
            start=(theta, value),
            limits=Limits(time_s=60.0),
        )
        return cls(instance, model, found.theta, found.upper_bound)


def methods() -> Iterator[tuple[str, str, Baseline]]:
    """Name, setting and method, for every method with bounds over boxes; the reference comes first."""
    names = registry.names()
    for name in sorted(names, key=lambda name: name != REFERENCE[0]):
        for options in SETTINGS.get(name, [{}]):
            method = registry.load(name, **options)
            if isinstance(method, BoxBounding) and method.available() is None:
                yield name, options.get("bound", ""), method


def boxes(case: Case, width: float) -> dict[str, list[Box]]:
    """Boxes of one width that hold the optimum, and that do not; the same directions at every width."""
    rng = np.random.default_rng(SEED)
    half, dim = 0.5 * width, case.theta.size
    inside = [case.theta + half * rng.uniform(-1, 1, dim) for _ in range(N_DRAWS)]
    if dim == 4:  # a quarter turn and a shift
        a, b, x, y = case.theta
        elsewhere = np.array([-b, a, x + 0.4, y - 0.4])
    else:
        elsewhere = case.theta + np.array([0.6, -0.5, 0.6])
    away = [elsewhere + 0.2 * rng.uniform(-1, 1, dim) for _ in range(N_DRAWS)]
    places = {"holds the optimum": inside, "away from it": away}
    return {
        place: [Box(centre - half, centre + half) for centre in centres]
        for place, centres in places.items()
    }


def least_met(case: Case, box: Box) -> float:
    """Least objective found in the box; its minimum where the box holds the optimum."""
    model = case.model
    thetas = np.vstack([box.centre, box.vertices(), box.sample(np.random.default_rng(SEED), 60)])
    descents = [np.clip(model.refine(theta)[0], box.lower, box.upper) for theta in thetas[:10]]
    thetas = np.vstack([thetas, descents])
    if ((box.lower <= case.theta) & (case.theta <= box.upper)).all():
        thetas = np.vstack([thetas, case.theta])
    return min((model.objective(t)[0] for t in thetas[model.admissible(thetas)]), default=np.inf)


def compare(name: str) -> pd.DataFrame:
    """Every method's bound on every box of one case; NaN where a method has none."""
    case, rows = Case.of(name), []
    able = [
        entry for entry in methods() if entry[2].supports(case.instance) is None
    ]  # those of the other model are no competitors here
    for width in WIDTHS:
        for place, drawn in boxes(case, float(width)).items():
            for draw, box in enumerate(drawn):
                least = least_met(case, box)
                if not np.isfinite(least):
                    continue  # no admissible pose: nothing to bound
                for method, setting, adapter in able:
                    began = time.perf_counter()
                    value = adapter.box_bound(case.instance, box.lower, box.upper)  # type: ignore[attr-defined]
                    rows.append(
                        {
                            "instance": name, "place": place, "width": float(width), "draw": draw,
                            "method": method, "setting": setting, "value": value, "least": least,
                            "time_s": time.perf_counter() - began,
                        }
                    )  # fmt: skip
    return pd.DataFrame(rows)


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Mean loss per method, place and width, and as a multiple of the reference's."""
    axes = ["instance", "place", "width"]
    mean = (
        table.assign(loss=table["least"] - table["value"])
        .groupby([*axes, "method", "setting"], sort=False)["loss"]
        .mean()
        .reset_index()
    )
    of_reference = (mean["method"] == REFERENCE[0]) & (mean["setting"] == REFERENCE[1])
    reference = mean[of_reference].set_index(axes)["loss"].rename("loss_of_reference")
    mean = mean.join(reference, on=axes)
    return mean.assign(ratio=mean["loss"] / mean["loss_of_reference"])


def draw(summary: pd.DataFrame, stem: Path) -> None:
    """Loss against width: a column per instance, a row per place."""
    import matplotlib
    from matplotlib.figure import Figure

    summary = summary.dropna(subset="loss")
    instances, places = summary["instance"].unique(), summary["place"].unique()
    figure = Figure(figsize=(4.2 * len(instances), 3.4 * len(places) + 1), layout="constrained")
    axes = figure.subplots(len(places), len(instances), sharex=True, squeeze=False)
    handles = {}
    dashes = ("-", "--", ":", "-.")
    for row, place in enumerate(places):
        for column, instance in enumerate(instances):
            axis = axes[row][column]
            part = summary[(summary["instance"] == instance) & (summary["place"] == place)]
            for (method, setting), line in part.groupby(["method", "setting"], sort=False):
                card = registry.read_card(method)
                settings = [options.get("bound", "") for options in SETTINGS.get(method, [{}])]
                (handle,) = axis.plot(
                    line["width"], line["loss"].where(line["loss"] > 1e-6), color=card.color,
                    marker=card.marker, markersize=4, linestyle=dashes[settings.index(setting)],
                )  # fmt: skip
                handles[f"{card.display_name} {setting}".strip()] = handle
            axis.set(xscale="log", yscale="log", title=f"{instance}: {place}")
            axis.grid(alpha=0.3)
        axes[row][0].set_ylabel("least objective met − bound")
    for axis in axes[-1]:
        axis.set_xlabel("box width (RMS radii of the target)")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    with matplotlib.rc_context({"svg.hashsalt": "bounds"}):
        figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})
    figure.savefig(stem.with_suffix(".png"), dpi=120)


def main(
    out: Annotated[Path, typer.Argument(help="folder for tables and figure")] = Path(
        "results/bounds"
    ),
) -> None:
    """Compare the bounds, store tables and figure, and print the losses on two widths."""
    tables = []
    for name in CASES:
        tables.append(compare(name))
        found = tables[-1]
        silent = found.groupby("method")["value"].apply(lambda value: value.isna().all())
        for method in silent[silent].index:
            typer.echo(f"{name}: {method} has no bound over these boxes")
    table = pd.concat(tables)
    summary = summarise(table)
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "boxes.csv", index=False)
    summary.to_csv(out / "summary.csv", index=False)
    draw(summary, out / "bounds")
    shown = summary[summary["width"].isin(WIDTHS[[2, 4]])]
    wide = shown.pivot_table(
        index=["method", "setting"], columns=["instance", "place", "width"], values="ratio",
        sort=False,
    )  # fmt: skip
    typer.echo("loss as a multiple of that of the published DC bound\n")
    typer.echo(wide.T.to_string(float_format=lambda value: f"{value:.3g}"))


if __name__ == "__main__":
    typer.run(main)
