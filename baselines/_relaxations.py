"""Branch and bound over 2D similarities with bounds of linearised products: RPM-BP and HBSP.

With phi1 = t1^2 + t2^2, phi2 = t1 t3 + t2 t4 and phi3 = t1 t4 - t2 t3 the objective has no products but
those of two variables: one an aggregate g_f = sum p_ij f_ij of the matching, one of theta or phi,

    E = g_xx phi1 + 2 g_x1 phi2 + 2 g_x2 phi3 - 2 (g_d t1 + g_w t2 + g_y1 t3 + g_y2 t4)
        + k (t3^2 + t4^2) + g_yy.

Each product is replaced by the mean of its two active McCormick facets over the range of g_f (of all
matchings) and of the other (over the box; exact, as the summands of each phi share no parameter). Then E
is a constant, a linear function of the matching, least at a k-assignment, and

    beta.theta + gamma.phi + k (t3^2 + t4^2),

which a method relaxes further in its own way, with phi tied to theta.
"""

from __future__ import annotations

import abc
import dataclasses
import time
from collections.abc import Callable

import numpy as np

from baselines._boxes import bound_of_box
from baselines._poses import rms_radius
from baselines.contract import Baseline, Instance, Limits, Solution, tiny
from dcreg.bounds.base import SpaceBound
from dcreg.kernels import termwise, vertices
from dcreg.kernels.assignment import k_assignment
from dcreg.kernels.compiling import jit
from dcreg.local import objective, polish
from dcreg.problem import Frame, Problem
from dcreg.search import Evaluation, Event, LongestEdge, Trace, branch_and_bound
from dcreg.search import Limits as SearchLimits
from dcreg.spaces import Similarity2D, Space

# Boxes divided in a round, few because a round with a convex programme a box must stay interruptible.
_PAIRS_PER_ROUND = 20_000
_MAX_ROUND = 4

# theta -> least beta.theta + gamma.phi + k (t3^2 + t4^2) over a box, relaxed, and where it is attained
LeastOverBox = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], tuple[float, np.ndarray]]


@jit
def linearise(features, low, high, k, lower, upper, constants, beta, gamma):
    """Constant with the least assignment, slopes in theta and in phi, of every box."""
    n, m = features.shape[1], features.shape[2]
    cost, alpha = np.empty((n, m)), np.empty(termwise.N_FEATURES)
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        alpha[:] = 0.0
        beta[box] = 0.0
        constant = 0.0
        for f in range(3):
            least, most = _phi_range(f, lo, up)
            cg, gamma[box, f], c0 = termwise.relax_product(
                1.0 if f == 0 else 2.0, low[f], high[f], least, most
            )
            alpha[f] += cg
            constant += c0
        for row in range(termwise.BILINEAR.shape[0]):
            f, a = termwise.BILINEAR[row, 0], termwise.BILINEAR[row, 1]
            cg, ct, c0 = termwise.relax_product(-2.0, low[f], high[f], lo[a], up[a])
            alpha[f] += cg
            beta[box, a] += ct
            constant += c0
        for i in range(n):
            for j in range(m):
                total = features[7, i, j]
                for f in range(termwise.N_FEATURES):
                    total += alpha[f] * features[f, i, j]
                cost[i, j] = total
        value, _ = k_assignment(cost, k)
        constants[box] = value + constant
    return lower.shape[0]


@jit
def _phi_range(f, lower, upper):
    if f == 0:
        pl, ph = termwise.product_range(0, 0, lower, upper)
        ql, qh = termwise.product_range(1, 1, lower, upper)
    elif f == 1:
        pl, ph = termwise.product_range(0, 2, lower, upper)
        ql, qh = termwise.product_range(1, 3, lower, upper)
    else:
        pl, ph = termwise.product_range(0, 3, lower, upper)
        qh, ql = termwise.product_range(1, 2, lower, upper)
        ql, qh = -ql, -qh
    return pl + ql, ph + qh


class SubstitutedBound(SpaceBound):
    """Common part of the bounds: the linear matching part, and the exact value of the candidate."""

    def __init__(self, model: Space, threads: int = 1) -> None:
        super().__init__(model, threads)
        n, m = len(model.source), model.target_features.shape[1]
        self.features = np.empty((termwise.N_FEATURES + 1, n, m))
        termwise.pair_features(model.source, model.target_features, self.features)
        self.low, self.high = np.empty(termwise.N_FEATURES), np.empty(termwise.N_FEATURES)
        termwise.feature_ranges(self.features, model.n_inliers, self.low, self.high)
        self.n_assignments += 2 * termwise.N_FEATURES

    @abc.abstractmethod
    def least_over_box(self) -> LeastOverBox:
        """A solver of the programme in theta and phi, for the use of one thread."""

    def _evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        model, count = self.model, len(lower)
        found = Evaluation(np.empty(count), np.empty_like(lower), np.empty(count))

        def work(part: slice) -> int:
            lo, up, bounds = lower[part], upper[part], found.lower_bounds[part]
            beta, gamma = np.empty_like(lo), np.empty((len(lo), 3))
            spent = linearise(
                self.features, self.low, self.high, model.n_inliers, lo, up, bounds, beta, gamma
            )
            least = self.least_over_box()
            for box in range(len(lo)):
                value, theta = least(beta[box], gamma[box], lo[box], up[box])
                bounds[box] += value
                found.thetas[part][box] = np.clip(theta, lo[box], up[box])
            return spent + vertices.objectives(
                model.kind, model.source, model.target_features, model.n_inliers,
                found.thetas[part], found.values[part],
            )  # fmt: skip

        self._run(work, count)
        return found


def gap_tolerance(instance: Instance, factor: float) -> float:
    """Absolute tolerance: `factor` times the target's RMS radius, per matched pair."""
    return float(instance.n_inliers * (factor * rms_radius(instance.target)) ** 2)


def round_size(n_pairs: int) -> int:
    return int(np.clip(_PAIRS_PER_ROUND // n_pairs, 1, _MAX_ROUND))


class SimilaritySearch(Baseline):
    """Best-first search of the library over 2D similarities with a bound of the method's own.

    Start box, first incumbent, descents, branching and polish are those of DC-Reg.
    """

    bound: type[SpaceBound]

    def warm_up(self, instance: Instance) -> None:
        self.solve(tiny(instance), Limits(time_s=30.0, nodes=100))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        began = time.perf_counter()
        gap_tol = gap_tolerance(instance, self.options["gap_tol_factor"])
        problem = Problem(
            instance.source, instance.target, instance.n_inliers, instance.model,
            instance.scale_range,
        )  # fmt: skip
        frame = Frame.of(problem)
        area = frame.unit**2
        model = Similarity2D(
            frame.source(problem.source),
            frame.target(problem.target),
            problem.n_inliers,
            problem.scale_range,
        )
        bound = self.bound(model, limits.threads)
        theta, value, spent = model.first_incumbent()
        found = branch_and_bound(
            bound,
            [model.start_box()],
            branching=LongestEdge(model.axis_weights),
            gap_tol=gap_tol / area,
            refine=model.refine,
            start=(theta, value),
            limits=SearchLimits(
                max(0.0, limits.time_s - (time.perf_counter() - began)),
                limits.nodes,
                limits.memory_mb,
            ),
            round_size=round_size(len(problem.source) * len(problem.target)),
        )
        pose = frame.pose(model.pose(found.theta))
        certified, _ = objective(problem.source, problem.target, pose, problem.n_inliers)
        final = certified
        if self.options["polish"]:
            pose, final, _, _ = polish(
                problem.source, problem.target, pose, problem.n_inliers, problem.scale_range
            )
        return Solution(
            found.status,
            pose,
            lower_bound=found.lower_bound * area,
            upper_bound=found.upper_bound * area,
            gap_tol=gap_tol,
            certificate_scope=model.scope,
            counters={"n_nodes": found.n_nodes, "n_assignments": found.n_assignments + spent},
            trace=trace_rows(found.events, area),
            extra={"objective": final, "objective_certified": certified},
        )

    def box_bound(self, instance: Instance, lower: np.ndarray, upper: np.ndarray) -> float:
        """Lower bound over a box of theta; see `baselines.contract.BoxBounding`."""
        return bound_of_box(self.bound, instance, lower, upper)


def trace_rows(events: list[Event], area: float, offset_s: float = 0.0) -> list[dict[str, object]]:
    """The history in squared units of the input, its times counted from `offset_s` earlier."""
    return Trace(
        [
            dataclasses.replace(
                event,
                time_s=event.time_s + offset_s,
                lower_bound=event.lower_bound * area,
                upper_bound=event.upper_bound * area,
            )
            for event in events
        ]
    ).rows()
