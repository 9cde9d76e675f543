"""Make the figures and the table of the README from one run: ``python -m docs.figures``.

The run disturbs an embedded shape as in the benchmark and registers it with several bounds. It writes to
`docs/images`: the clouds before and after, the bounds against time (both for light and dark pages), and
the table of the runs, which the README repeats.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import dcreg
from baselines import registry
from baselines._shared.tolerance import absolute_tolerance
from baselines.contract import Limits
from data.registry import dataset
from dcreg.problem import apply_pose
from reports import theme
from reports.figures import printing
from workflows.disturb import make_instance

HERE = Path(__file__).parent
IMAGES = HERE / "images"
POINTS, LEVEL = 60, 0.1
NAMES = {
    "tight": "`tight` (default)",
    "dc": "`dc` (as published)",
    "termwise": "`termwise` (RPM-HTB, reconstructed)",
}


def instance(n_points: int, level: float):
    """Return the embedded fish with mixed outliers and a random pose."""
    return make_instance(
        dataset("embedded"), "fish", "mixed_outliers", level, trial=0, n_points=n_points
    )


def tolerance(problem) -> float:
    """Return the objective of a residual of 1 % of the RMS radius of the target per pair."""
    return absolute_tolerance(problem.target, len(problem.pairs), 0.01)


def solve_ours(problem, bound: str, time_limit: float) -> dcreg.Result:
    """Solve with a bound of the library, to the tolerance."""
    return dcreg.register(
        problem.source,
        problem.target,
        n_inliers=len(problem.pairs),
        model="similarity2d",
        rel_gap=0.0,
        abs_gap=tolerance(problem),
        time_limit=time_limit,
        options=dcreg.SolveOptions(bound=bound),
    )


def solve(problem, time_limit: float) -> dict[str, dcreg.Result]:
    """Solve with each bound, to the tolerance."""
    count, abs_gap = len(problem.pairs), tolerance(problem)
    results = {bound: solve_ours(problem, bound, time_limit) for bound in ("tight", "dc")}
    posed = dcreg.Problem(problem.source, problem.target, count, "similarity2d")
    rpm_htb = registry.load("rpm_htb")
    return results | {"termwise": rpm_htb.result(posed, Limits(time_limit), 0.0, abs_gap)}


def table(results: dict[str, dcreg.Result]) -> str:
    """Return a Markdown table with one row per bound."""
    lines = [
        "| bound | status | lower bound | upper bound | boxes | assignments | time |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for bound, result in results.items():
        lines.append(
            f"| {NAMES[bound]} | `{result.status}` | {result.lower_bound:.3f} | "
            f"{result.upper_bound:.3f} | {result.n_nodes:,} | {result.n_assignments:,} | "
            f"{result.time_solve_s:.1f}\N{NO-BREAK SPACE}s |"
        )
    return "\n".join(lines) + "\n"


def registration_figure(problem, result: dcreg.Result, surface: str) -> Figure:
    """Draw both clouds, and then the moved source with its matched pairs."""
    figure = Figure(figsize=(8.4, 3.4))
    before, after = figure.subplots(1, 2)
    moved = apply_pose(result.T_target_source, problem.source)
    for axes, source in ((before, problem.source), (after, moved)):
        axes.scatter(*source.T, s=16, marker="o", facecolors="none",
                     edgecolors=theme.SOURCE_COLOR[surface], label="source")  # fmt: skip
        axes.scatter(*problem.target.T, s=16, marker="+", linewidths=1.0,
                     color=theme.TARGET_COLOR[surface], label="target")  # fmt: skip
        axes.set(
            aspect="equal", xticks=[], yticks=[], title="before" if axes is before else "after"
        )
        axes.spines[:].set_visible(False)
    pairs = np.stack([moved[result.assignment[:, 0]], problem.target[result.assignment[:, 1]]])
    after.plot(*pairs.transpose(2, 0, 1), color=printing.INK[surface], linewidth=0.5, zorder=0)
    before.legend(loc="upper left", frameon=False)
    return figure


def bounds_figure(results: dict[str, dcreg.Result], surface: str) -> Figure:
    """Draw the lower (solid) and upper (dashed) bound of each search against time.

    Dots mark certified optima, crosses mark time-outs.
    """
    figure = Figure(figsize=(8.4, 3.4))
    axes = figure.subplots()
    for (bound, result), color in zip(results.items(), theme.FALLBACK_COLORS, strict=False):
        color = theme.readable(color, theme.SURFACE[surface])
        events = [event for event in result.trace if event.stage == "search"]
        time = [max(event.time_s, 1e-3) for event in events]
        for side, style in (("lower_bound", "-"), ("upper_bound", "--")):
            values = [getattr(event, side) for event in events]
            axes.step(time, values, style, where="post", color=color, linewidth=1.6,
                      label=bound if style == "-" else None)  # fmt: skip
        axes.plot(time[-1], events[-1].lower_bound, color=color,
                  marker="o" if result.success else "x", clip_on=False)  # fmt: skip
    best = min(result.upper_bound for result in results.values())
    axes.set(xscale="log", ylim=(-0.05 * best, 1.4 * best))
    axes.set(xlabel="time (s)", ylabel="bounds on the objective")
    axes.legend(loc="center", bbox_to_anchor=(0.48, 0.45), frameon=False)
    return figure


def write(folder: Path, n_points: int, level: float, time_limit: float) -> None:
    """Solve, and write all figures and the table to `folder`."""
    problem = instance(n_points, level)
    results = solve(problem, time_limit)
    folder.mkdir(parents=True, exist_ok=True)
    for surface in theme.SURFACE:
        with printing.style(surface):
            registration = registration_figure(problem, results["tight"], surface)
            bounds = bounds_figure(results, surface)
        for kind, figure in (("registration", registration), ("bounds", bounds)):
            path = folder / f"{kind}-{surface}.svg"
            path.write_bytes(printing.rendered(figure, "svg", surface))
    (folder / "runs.md").write_text(table(results), encoding="utf-8")


def show_in_readme(runs: Path, readme: Path) -> None:
    """Replace the table of an earlier run in the README."""
    new, text = runs.read_text(encoding="utf-8"), readme.read_text(encoding="utf-8")
    readme.write_text(
        re.sub(r"^\| bound \|(?:.*\n)+?(?=\n)", lambda _: new, text, flags=re.M), "utf-8"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=IMAGES)
    parser.add_argument("--points", type=int, default=POINTS)
    parser.add_argument("--level", type=float, default=LEVEL, help="outliers per point")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds per bound")
    asked = parser.parse_args()
    write(asked.folder, asked.points, asked.level, asked.time_limit)
    if asked.folder == IMAGES:
        show_in_readme(IMAGES / "runs.md", HERE.parent / "README.md")
