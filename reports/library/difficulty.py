"""Features of a problem that predict the effort of its proof: a table, a fitted model and a sentence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from data.library.features import Features, features_of
from data.library.problem import Problem
from data.library.record import Record, SolveEntry

LABELS = {
    "n_points": "points per cloud",
    "pair_share": "pairs, share of the smaller cloud",
    "overlap": "true pairs, share of the larger cloud",
    "residual": "RMS residual, in median spacings",
    "asymmetry": "asymmetry, in median spacings",
}
NAMES = {
    "n_points": "the number of points",
    "pair_share": "the share of points to match",
    "overlap": "the overlap",
    "residual": "the residual relative to the spacing",
    "asymmetry": "the asymmetry of the source",
}
LOGARITHMIC = ("n_points", "residual")
SHORTEST_S = 0.01  # shorter times are not resolved


@dataclass(frozen=True)
class Model:
    """Least-squares fit of the logarithm of the CPU time to standardised features and the model.

    Attributes
    ----------
    factors : dict
        Factor of the time for one standard deviation more of each feature.
    r_squared : float
        Share of the variance that all features explain.
    n_problems : int
    n_open : int
        Those whose search ended without a proof; their time is a lower limit.
    """

    factors: dict[str, float]
    r_squared: float
    n_problems: int
    n_open: int

    def sentence(self) -> str:
        """Return the finding in one sentence."""
        order = sorted(self.factors, key=lambda name: -abs(np.log(self.factors[name])))
        first, second = order[:2]
        factors = (f"{self.factors[name]:.2g}" for name in (first, second))
        return (
            f"The best predictor of the time of a search is {NAMES[first]}: one standard deviation more "
            f"multiplies the time by {next(factors)}; next is {NAMES[second]} (factor {next(factors)}). "
            f"Together, {len(self.factors)} features and the model explain {100 * self.r_squared:.0f} % "
            f"of the variance of log time over {self.n_problems} problems; the searches of {self.n_open} "
            "ended without a proof."
        )


def table(known: Iterable[tuple[Problem, Record]]) -> pd.DataFrame:
    """Return a row per problem: features, time of the solve with a certificate, and status.

    Searches that ended without a proof had different limits, so all have the time of the longest one.
    """
    rows = []
    for problem, record in known:
        solve = proof_solve(record)
        if solve is None or record.best_pose is None:
            continue
        rows.append(
            {
                "problem": problem.id, "model": problem.model, "family": problem.family,
                "status": record.status(problem), **asdict(features_of(problem, record)),
                "cpu_s": max(solve.cpu_s, SHORTEST_S), "is_limit": solve.status != "optimal",
            }
        )  # fmt: skip
    found = pd.DataFrame(rows)
    found.loc[found["is_limit"], "cpu_s"] = found["cpu_s"].max()
    return found


def proof_solve(record: Record) -> SolveEntry | None:
    """Return the solve with a certificate that ended with a proof, or the longest one."""
    solves = [solve for solve in record.solves if solve.options]
    ended = [solve for solve in solves if solve.status == "optimal"]
    return ended[0] if ended else max(solves, key=lambda solve: solve.cpu_s, default=None)


def fit(rows: pd.DataFrame) -> Model:
    """Fit the model to the table."""
    names = list(Features.__dataclass_fields__)
    values = rows[names].copy()
    for name in LOGARITHMIC:
        values[name] = np.log10(values[name].clip(lower=1e-3))
    standard = (values - values.mean()) / values.std().replace(0.0, 1.0)
    is_3d = (rows["model"] == "rigid3d").to_numpy(float)
    design = np.column_stack([np.ones(len(rows)), is_3d, standard.to_numpy()])
    effort = np.log10(rows["cpu_s"].to_numpy())
    weights, *_ = np.linalg.lstsq(design, effort, rcond=None)
    left = effort - design @ weights
    explained = 1.0 - float((left**2).sum() / ((effort - effort.mean()) ** 2).sum())
    factors = {name: float(10.0**w) for name, w in zip(names, weights[2:], strict=True)}
    return Model(factors, explained, len(rows), int(rows["is_limit"].sum()))
