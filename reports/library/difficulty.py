"""Features of a problem that predict the effort of its proof: a table, a fitted model and a sentence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.stats import norm

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
    """Fit of the logarithm of the CPU time of a proof to standardised features and the model.

    The time of a search without a proof is a lower limit of the time of the proof (Tobin, 1958).

    Attributes
    ----------
    factors : dict
        Factor on the time for an increase of each feature by one standard deviation.
    explained : float
        Share of the variance that all features explain, for the fitted normal distribution.
    n_problems : int
    n_open : int
        Those whose search ended without a proof.
    """

    factors: dict[str, float]
    explained: float
    n_problems: int
    n_open: int

    def sentence(self) -> str:
        """Return the finding in one sentence."""
        order = sorted(self.factors, key=lambda name: -abs(np.log(self.factors[name])))
        first, second = order[:2]
        factors = (f"{self.factors[name]:.2g}" for name in (first, second))
        return (
            f"The best predictor of the time of a proof is {NAMES[first]}: an increase by one standard "
            f"deviation multiplies the time by {next(factors)}; next is {NAMES[second]} (factor "
            f"{next(factors)}). "
            f"Together, {len(self.factors)} features and the model explain {100 * self.explained:.0f} % "
            f"of the variance of log time over {self.n_problems} problems. {self.n_open} searches ended "
            "without a proof; their times count as lower limits."
        )


def table(known: Iterable[tuple[Problem, Record]]) -> pd.DataFrame:
    """Return a row per problem: features, time of the solve with a certificate, and status."""
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
    return pd.DataFrame(rows)


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
    weights, spread = _censored_fit(design, effort, rows["is_limit"].to_numpy(bool))
    signal = float(np.var(design @ weights))
    factors = {name: float(10.0**w) for name, w in zip(names, weights[2:], strict=True)}
    explained = signal / (signal + spread**2)
    return Model(factors, explained, len(rows), int(rows["is_limit"].sum()))


def _censored_fit(
    design: np.ndarray, effort: np.ndarray, is_limit: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the most likely weights and standard deviation if some efforts are lower limits only."""

    def loss(unknown: np.ndarray) -> float:
        spread = np.exp(unknown[-1])
        z = (effort - design @ unknown[:-1]) / spread
        return -float(np.where(is_limit, norm.logsf(z), norm.logpdf(z) - unknown[-1]).sum())

    start, *_ = np.linalg.lstsq(design, effort, rcond=None)
    found = minimize(loss, [*start, np.log(np.std(effort - design @ start))], method="BFGS").x
    return found[:-1], float(np.exp(found[-1]))
