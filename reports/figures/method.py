"""Functions of the published bound along a line through a box, for the drawings of the method.

Nothing is made up: the box is one that Algorithm 1 (`baselines.dcreg_paper`) bounds on a generated
instance in 3D, and all values are those of its norm stage.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from baselines._shared.algorithm1 import Bounded, algorithm_1
from baselines._shared.centred import Centred
from baselines._shared.published import NormBound, vertices_of
from baselines.contract import Instance
from data.registry import dataset
from dcreg.assignment.objective import k_assignment
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Budget
from reports.figures.figure import Figure
from reports.figures.grid import Grid
from workflows.disturb import make_instance

SHAPE, TEST, LEVEL, POINTS = "pony", "noise", 0.03, 40
BOXES = 61  # boxes that Algorithm 1 bounds; the last one is drawn
STEPS = 201  # points of a curve
ROLES = ("convex", "concave", "objective", "bound", "fixed")
INSTANCE = (
    f"Shape {SHAPE}, {TEST} {LEVEL:g}, {POINTS} points; the box is number {BOXES} of Algorithm 1."
)


class _Recorder(NormBound):
    """The published bound, which keeps the boxes that it bounds."""

    def __init__(self, space: Translation3D) -> None:
        super().__init__(space)
        self.boxes: list[Box] = []

    def evaluate(self, boxes: list[Box]) -> list[Bounded]:
        self.boxes += boxes
        return super().evaluate(boxes)


@dataclass(frozen=True)
class Section:
    """The diagonal of a box from the minimising vertex, in norm space.

    Attributes
    ----------
    space : Translation3D
    box : Box
    bounded : Bounded
        What the published bound returns for the box.
    at : (s,) array
        Positions on the diagonal: -1 at the minimising vertex, 0 at the centre, 1 at the opposite vertex.
    t : (s, 3) array
        The translations there.
    """

    space: Translation3D
    box: Box
    bounded: Bounded
    at: np.ndarray
    t: np.ndarray

    @property
    def norms(self) -> np.ndarray:
        """Return the (s, n) norms of the moved source points."""
        source = self.space.clouds.source.T
        return np.linalg.norm(source[None] + self.t[:, None], axis=2)

    @property
    def dropped(self) -> np.ndarray:
        """Return the (s,) gaps of the tangent of one pair: the squared distance from the centre."""
        return ((self.t - self.box.centre) ** 2).sum(axis=1)

    def objective(self) -> np.ndarray:
        """Return the (s,) values of E."""
        values = np.empty(len(self.t))
        self.space.objectives(np.ascontiguousarray(self.t), values)
        return values

    def relaxed(self) -> np.ndarray:
        """Return the (s,) values of z, whose minimum over the vertices is the published bound."""
        return self.objective() - self.space.n_inliers * self.dropped

    def at_vertices(self) -> np.ndarray:
        """Return the values of z at the vertices of the box."""
        vertices = vertices_of(self.box)
        values = np.empty(len(vertices))
        self.space.objectives(vertices, values)
        return values - self.space.n_inliers * ((vertices - self.box.centre) ** 2).sum(axis=1)

    def matching(self, position: int) -> np.ndarray:
        """Return the (n,) columns that are matched at a position, -1 for none."""
        cost = (self.norms[position][:, None] - self.space.norms[None]) ** 2
        return k_assignment(cost, self.space.n_inliers)[1]

    def with_matching(self, columns: np.ndarray) -> np.ndarray:
        """Return the (s,) values of the relaxed objective with a fixed matching: a concave function."""
        rows = np.flatnonzero(columns >= 0)
        residuals = self.norms[:, rows] - self.space.norms[columns[rows]][None]
        return (residuals**2).sum(axis=1) - self.space.n_inliers * self.dropped


@cache
def section() -> Section:
    """Run Algorithm 1 for `BOXES` boxes and return the section through the last one."""
    raw = make_instance(dataset("embedded"), SHAPE, TEST, LEVEL, trial=0, n_points=POINTS)
    problem = Centred.of(
        Instance(
            "", raw.source, raw.target, "rigid3d", len(raw.pairs), raw.scale_range, 0.0, seed=0
        ),
        "source",
    )
    with Budget(nodes=BOXES) as budget:
        space = problem.space(budget.stop)
        assert isinstance(space, Translation3D)
        recorder = _Recorder(space)
        algorithm_1(recorder, [problem.start_box("extent")], problem.epsilon(0.01), budget)
        assert len(recorder.boxes) == BOXES
        box = recorder.boxes[-1]
        (bounded,) = recorder.evaluate([box])
    at = np.linspace(-1.0, 1.0, STEPS)
    t = box.centre + at[:, None] * (box.centre - bounded.theta)
    return Section(space, box, bounded, at, t)


def curve(
    at: np.ndarray, values: np.ndarray, axes: tuple[str, str], role: str, name: str, **look: Any
) -> dict[str, Any]:
    """Return a trace of a drawing."""
    line = {"width": 1.5, "dash": look.get("dash", "solid")}
    return {
        "x": np.atleast_1d(at), "y": np.atleast_1d(values), "xaxis": axes[0], "yaxis": axes[1],
        "mode": look.get("mode", "lines"), "line": line, "name": name,
        "marker": {"symbol": "circle", "size": 7}, "meta": {"role": role},
    }  # fmt: skip


def assemble(identity: str, title: str, grid: Grid, traces: list[dict[str, Any]]) -> Figure:
    payload = {"views": {"": {"data": traces, "layouts": grid.layouts()}}, "scales": {}}
    return Figure(identity, title, "plain", payload, grid)
