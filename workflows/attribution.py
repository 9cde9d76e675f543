"""Attribute every wrong pose to the search or to the objective, from the table of all runs.

Runs of one instance with the same number of pairs are compared by the objective that the harness
computes at each pose. `records.runs_columns` shows the columns added here.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from dcreg.names import POSE_SCOPES
from workflows.outcomes import STARTED

# verdict -> (heading, explanation)
VERDICTS = {
    "right": ("right pose", "success, and no clearly lower objective is known"),
    "right_not_optimal": ("right, not optimal", "success, although a lower objective is known"),
    "search_error": (
        "search error",
        "wrong pose, and a pose with a clearly lower objective exists: E(found) > E(best) + tol",
    ),
    "model_error": (
        "model error",
        "wrong pose with an objective no higher than the reference's: E(found) ≤ E(reference)",
    ),
    "undecided": (
        "undecided",
        "wrong pose; its objective is within the tolerance of the best known, but above E(reference)",
    ),
    "inadmissible": ("inadmissible", "wrong pose with a scale outside the given range"),
    "not_evaluated": (
        "not evaluated",
        "clouds too large to compute the objective, or a method that received fewer points",
    ),
    "no_pose": ("no pose", "the run was started and returned no pose"),
}

# name -> kind and meaning, see `workflows.records.Column`
COLUMNS: dict[str, tuple[type, str]] = {
    "verdict": (str, f"one of {', '.join(VERDICTS)}; empty if the run was not started"),
    "optimum_at_least": (
        float,
        "maximum lower bound that any run certified for the pose objective of this instance and "
        "n_inliers; empty if none did",
    ),
    "regret_at_most": (
        float,
        "objective - optimum_at_least: with objective_regret a certified interval of the regret",
    ),
}
_PROBLEM = ["instance_id", "n_inliers"]


def attribute(runs: pd.DataFrame) -> pd.DataFrame:
    """Add `COLUMNS` to runs that have raw results, metrics and ``outcome``."""
    lower = optimum_at_least(runs)
    return runs.assign(
        verdict=verdicts(runs),
        optimum_at_least=lower,
        # Empty like the regret: a pose outside the range may have an objective below every bound.
        regret_at_most=(runs["objective"] - lower).where(runs["admissible"].astype(bool)),
    )


def optimum_at_least(runs: pd.DataFrame) -> pd.Series:
    """Return the maximum lower bound certified for a run's problem by any run of the pose scopes."""
    bound = runs["lower_bound"].where(runs["certificate_scope"].isin(POSE_SCOPES))
    maximum = bound.groupby([runs[key] for key in _PROBLEM]).transform("max")
    # An exact search reaches its optimum up to rounding, which must not make an interval empty.
    best = runs["objective_best"]
    rounding = (maximum > best) & (maximum <= best + _rounding(best))
    return maximum.mask(rounding, best)


def tolerance(runs: pd.DataFrame) -> pd.Series:
    """Return the difference up to which two objectives count as equal.

    This is the minimum tolerance of the gap of the runs on the problem, of certified ones if there are
    any. Tolerances of other objectives do not apply. Without any: 1 % of the objective at the reference.
    """
    groups = [runs[key] for key in _PROBLEM]
    gap_tol = runs["gap_tol"].where(runs["certificate_scope"].isin(POSE_SCOPES))
    of_proofs = gap_tol.where(runs["status"].eq("optimal")).groupby(groups).transform("min")
    of_any = gap_tol.groupby(groups).transform("min")
    stated = of_proofs.fillna(of_any).fillna(0.01 * runs["objective_true"].abs()).fillna(0.0)
    return stated + _rounding(runs["objective_best"])


def verdicts(runs: pd.DataFrame) -> pd.Series:
    """Return one of `VERDICTS` for every run that was started.

    The best known objective is an upper bound on the optimum: a value that exceeds it by more than the
    tolerance proves a search error, whether or not the optimum is certified.
    """
    success, admissible = runs["success"].astype(bool), runs["admissible"].astype(bool)
    behind = runs["objective"] - runs["objective_best"] > tolerance(runs)
    preferred = runs["objective"] <= runs["objective_true"]
    conditions = {
        "": ~runs["outcome"].isin(STARTED),
        "no_pose": runs["rmse"].isna(),
        "not_evaluated": runs["objective"].isna(),
        "right_not_optimal": success & behind,
        "right": success,
        "inadmissible": ~admissible,
        "search_error": behind,
        "model_error": preferred,
    }
    chosen = np.select(list(conditions.values()), list(conditions), "undecided")
    return pd.Series(chosen, index=runs.index)


def _rounding(values: pd.Series) -> pd.Series:
    return 1e-9 * (1 + values.abs())
