"""Whose fault is a wrong pose: the search's or the objective's? From the table of all runs.

Runs are compared on one instance with one number of pairs, by the harness's own value of the
objective at each pose. `records.runs_columns` shows the columns made here.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from workflows.metrics import POSE_SCOPES
from workflows.outcomes import STARTED

# verdict -> (heading, explanation)
VERDICTS = {
    "right": ("right pose", "success, objective as good as any known"),
    "right_not_optimal": ("right, not optimal", "success although a lower objective is known"),
    "search_error": (
        "search error",
        "wrong pose, and a pose with a clearly lower objective exists: E(found) > E(best) + tol",
    ),
    "model_error": (
        "model error",
        "wrong pose that the objective prefers to the reference: E(found) ≤ E(reference)",
    ),
    "undecided": (
        "undecided",
        "wrong pose, objective within the tolerance of the best known but above E(reference)",
    ),
    "inadmissible": ("inadmissible", "wrong pose, outside the told range of scales"),
    "not_evaluated": (
        "not evaluated",
        "a pose of clouds too large for the objective, or of a method that was given fewer points",
    ),
    "no_pose": ("no pose", "the run was started and gave no pose"),
}

COLUMNS: dict[str, tuple[type, str]] = {
    "verdict": (str, f"one of {', '.join(VERDICTS)}; empty if the run was not started"),
    "optimum_at_least": (
        float,
        "greatest lower bound any run certified for this objective (scope: the pose itself), instance "
        "and n_inliers; empty if none did",
    ),
    "regret_at_most": (
        float,
        "objective - optimum_at_least: with objective_regret a certified interval of the regret",
    ),
}
_ALIKE = ["instance_id", "n_inliers"]


def attribute(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs with `COLUMNS`; of theirs it needs raw results, metrics and ``outcome``."""
    lower = optimum_at_least(runs)
    return runs.assign(
        verdict=verdicts(runs),
        optimum_at_least=lower,
        # As empty as the regret: a pose outside the range may lie below every bound.
        regret_at_most=(runs["objective"] - lower).where(runs["admissible"].astype(bool)),
    )


def optimum_at_least(runs: pd.DataFrame) -> pd.Series:
    """The greatest lower bound certified for a run's problem by any run of the same scope."""
    bound = runs["lower_bound"].where(runs["certificate_scope"].isin(POSE_SCOPES))
    greatest = bound.groupby([runs[key] for key in _ALIKE]).transform("max")
    # An exact search meets its optimum up to rounding, which must not make an interval empty.
    best = runs["objective_best"]
    rounding = (greatest > best) & (greatest <= best + _rounding(best))
    return greatest.mask(rounding, best)


def tolerance(runs: pd.DataFrame) -> pd.Series:
    """What counts as equal objectives: the least tolerance of a gap on this problem, of proofs first.

    Tolerances of other objectives, of which some are counts, say nothing of this one. Without any, 1 % of
    the objective at the reference.
    """
    groups = [runs[key] for key in _ALIKE]
    speaks = runs["certificate_scope"].isin(POSE_SCOPES)
    gap_tol = runs["gap_tol"].where(speaks)
    of_proofs = gap_tol.where(runs["status"].eq("optimal")).groupby(groups).transform("min")
    of_any = gap_tol.groupby(groups).transform("min")
    stated = of_proofs.fillna(of_any).fillna(0.01 * runs["objective_true"].abs()).fillna(0.0)
    return stated + _rounding(runs["objective_best"])


def verdicts(runs: pd.DataFrame) -> pd.Series:
    """One of `VERDICTS` for every run that was started.

    The best known objective is an upper bound on the optimum: a value above it by more than the
    tolerance proves an error of the search, whether the optimum is certified or not.
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
