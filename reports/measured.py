"""What runs show about bounds, searches, n_inliers and certificates, as tables of text.

`Measured` holds the columns that this needs. Every interval is a 95 % interval over instances: that of
Wilson for shares, a bootstrap of percentiles for the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from baselines import registry
from dcreg.names import NORM_SCOPES, POSE_SCOPES
from reports import theme
from reports.ledger.evidence import NO_POSE
from reports.tables import COVERAGE, Tables, share_interval
from reports.theme import MISSING, integer, number, words
from workflows.hashing import digest
from workflows.metrics.errors import SUCCESS_SHARE
from workflows.outcomes import attempted, comparable_times

DRAWS = 4000
MOST_COUNTS = 10_000_000  # of a bootstrap, in double precision at the same time
SMALL = 0.02  # relative: searches stop at about the same limit on assignments
SEED = 20260326
OURS, WITH_DISTANCES = "ours", "ours, with distances"
# Searches of a method itself: as its paper states it, and where parts of it are choices of this project.
STATED, RECONSTRUCTED = "its own (Algorithm 1)", "its own (reconstructed)"
PUBLISHED = "DC, published"
CERTIFIED_GAP = 0.01  # relative gap up to which an optimum counts as certified, for all methods
CERTIFIED = f"L/U ≥ {1 - CERTIFIED_GAP:g}"
# Columns of `Measured.runs`, besides those added by `Measured.of_tables`.
KEPT = (
    "run_id", "instance_id", "model", "shape", "test", "level", "trial", "method", "display_name",
    "n_inliers_ratio", "n_source", "status", "outcome", "certificate_scope", "success", "rmse_over_scale",
    "lower_bound", "upper_bound", "bound_ratio", "gap_tol", "objective", "objective_true",
    "n_nodes", "n_assignments", "time_solve_s", "norm_translation_error",
)  # fmt: skip
STAGE = ("run_id", "stage")
STAGE_ENDS = ("n_nodes", "n_assignments", "lower_bound", "upper_bound")


@dataclass(frozen=True)
class Shown:
    """A table of text; the first column names the row."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Return the table in Markdown, the numbers aligned to the right."""
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *self.rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@dataclass(frozen=True)
class Measured:
    """Attempted runs, and the end of each of their searches.

    Attributes
    ----------
    runs : DataFrame
        `KEPT`, and ``bound``, ``search`` (empty for methods without bounds) and ``family``: the method
        without its share of the pairs.
    stages : DataFrame
        ``run_id``, ``stage`` and the last ``n_nodes``, ``n_assignments``, ``lower_bound`` and
        ``upper_bound``.
    """

    runs: pd.DataFrame
    stages: pd.DataFrame

    @classmethod
    def of_tables(cls, tables: Tables) -> Measured:
        import polars as pl

        runs = tables.runs[list(KEPT)].assign(time_solve_s=comparable_times(tables.runs))
        runs = attempted(runs)
        found = pd.DataFrame(
            {
                (model, label): kind({"baseline": label, **card}, model)
                for label, card in tables.cards.items()
                for model in runs["model"].unique()
            },
            index=["bound", "search"],
        ).T
        families = {
            label: digest([card.get("baseline", label), options_of(card)], 8)
            for label, card in tables.cards.items()
        }
        runs = runs.join(found, on=["model", "method"]).fillna({"bound": "", "search": ""})
        runs = runs.assign(family=runs["method"].map(families))
        own = pl.from_pandas(runs[["run_id"]]).lazy()
        events = tables.scan_traces().join(own, on="run_id", how="semi", maintain_order="left")
        ends = pl.col(STAGE_ENDS).drop_nulls().last()
        stages = events.group_by(STAGE, maintain_order=True).agg(ends).collect().to_pandas()
        return cls(runs.reset_index(drop=True), stages)

    def __post_init__(self) -> None:
        runs = self.runs
        error = runs["rmse_over_scale"].fillna(NO_POSE)
        of_pose = runs["certificate_scope"].isin(POSE_SCOPES)
        object.__setattr__(
            self,
            "runs",
            runs.assign(
                success=runs["success"].astype(bool),
                error=error,
                # not the status: tolerances differ between methods
                certified=(runs["bound_ratio"] >= 1.0 - CERTIFIED_GAP - 1e-9) & of_pose,
                closed=runs["bound_ratio"].clip(0.0, 1.0),
            ),
        )


def kind(card: Mapping[str, Any], model: str) -> tuple[str, str]:
    """Return the bounding function of a method and whose search uses it; empty if it has none.

    In 3D the library bounds norm space only in mode ``paper``.
    """
    options, name = options_of(card), str(card.get("display_name", ""))
    if card["baseline"] in registry.names():  # a label may name the search as well
        name = registry.read_card(card["baseline"]).display_name
    if card["baseline"] == "dcreg_paper":
        return PUBLISHED, STATED
    if card["baseline"] == "dcreg":
        if model == "rigid3d" and options.get("mode") != "paper":
            return "", ""
        bound = PUBLISHED if options.get("bound") == "dc" else "DC, tight"
        # a bound that is asked for works alone
        return bound, WITH_DISTANCES if options.get(
            "bound"
        ) is None and model != "rigid3d" else OURS
    searches = {"own": RECONSTRUCTED, "ours": OURS}
    if options.get("search") in searches:
        bound = name.split(",")[0].split("(")[0].strip().removesuffix(" bound")
        return bound, searches[options["search"]]
    return "", ""


# --- intervals --------------------------------------------------------------------------------


def share(values: pd.Series) -> str:
    """Return a share of runs with Wilson's interval, in per cent."""
    if values.empty:
        return MISSING
    return theme.share(values.mean(), *share_interval(int(values.sum()), len(values)))


def estimate(statistic: Callable[..., Any], *samples: pd.Series) -> tuple[float, float, float]:
    """Return a statistic of the means of paired samples with its bootstrap interval."""
    data = np.column_stack([np.asarray(sample, dtype=float) for sample in samples])
    value = float(statistic(*data.mean(axis=0)))
    if np.isnan(value) or (data == data[0]).all():
        return value, value, value
    counts = _resampled(len(data))
    blocks = np.array_split(counts, -(-counts.size // MOST_COUNTS))
    means = np.concatenate([block.astype(float) @ data for block in blocks]) / len(data)
    ends = np.quantile(statistic(*means.T), [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return value, float(ends[0]), float(ends[1])


@lru_cache(maxsize=4)
def _resampled(n: int) -> np.ndarray:
    """Return how often each of `n` instances is drawn, (draws, n): the same for all estimates."""
    drawn = np.random.default_rng(SEED).integers(0, n, (DRAWS, n))
    drawn += n * np.arange(DRAWS)[:, None]
    return np.bincount(drawn.ravel(), minlength=DRAWS * n).reshape(DRAWS, n).astype(np.float32)


def _itself(mean: np.ndarray) -> np.ndarray:
    return mean


def _shown(found: tuple[float, float, float], digits: int = 2) -> str:
    value, low, high = (number(end, digits) for end in found)
    return f"{value} [{low}, {high}]"


def _change(found: tuple[float, float, float]) -> str:
    """Return a difference of shares in per cent; a tie of all runs has no interval."""
    value, low, high = (100 * end for end in found)
    return f"{value:+.0f} % [{low:+.0f}, {high:+.0f}]" if low != high else f"{value:+.0f} %"


def decision(found: tuple[float, float, float], equal: float) -> str:
    """Return on which side of `equal` an interval lies; differences below `SMALL` are no difference."""
    _, low, high = found
    below, above = equal * (1 - SMALL), equal * (1 + SMALL)
    return "lower" if high < below else "higher" if low > above else "open"


def groups(
    frame: pd.DataFrame, keys: Sequence[str], *, sort: bool = False
) -> Iterator[tuple[list[str], pd.DataFrame]]:
    """Return the parts of a table with equal keys, and the keys as text."""
    for key, part in frame.groupby(list(keys), sort=sort):
        yield [f"{value:g}" if isinstance(value, float) else str(value) for value in key], part


# --- tables -----------------------------------------------------------------------------------


def paired(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of instances that every method attempted."""
    counts = runs.groupby("instance_id")["method"].nunique()
    return runs[runs["instance_id"].isin(counts[counts == runs["method"].nunique()].index)]


def bounding(measured: Measured, model: str) -> pd.DataFrame:
    """Return the runs of methods that bound boxes of poses, with all pairs, on common instances."""
    runs = measured.runs
    runs = runs[runs["model"].eq(model) & runs["bound"].ne("") & runs["n_inliers_ratio"].eq(1)]
    # one method per bound and search
    first = runs.drop_duplicates(["bound", "search"])["method"]
    return paired(runs[runs["method"].isin(first)])


def separation(measured: Measured, model: str) -> Shown | None:
    """Tabulate bound and search; None without a bound in two searches."""
    runs = bounding(measured, model)
    if runs.empty or runs.groupby("bound")["search"].nunique().max() < 2:
        return None
    rows = []
    for (bound, search), part in groups(runs, ["bound", "search"], sort=True):
        rows.append([
            bound, search, str(len(part)), share(part["success"]),
            _shown(estimate(_itself, part["error"])), share(part["certified"]),
            number(part["closed"].median(), 2), _count(part["n_nodes"]),
            _count(part["n_assignments"]), number(part["time_solve_s"].median(), 2),
        ])  # fmt: skip
    head = (
        "bound", "search", "instances", "success rate", "mean RMSE (longest sides)", CERTIFIED,
        "median lower / upper bound", "median boxes", "median assignments", "median time (s)",
    )  # fmt: skip
    return Shown(head, rows)


def effects(measured: Measured, model: str) -> Shown | None:
    """Compare two bounds in one search, and two searches with one bound, on the same instances."""
    runs = bounding(measured, model)
    rows = []
    for fixed, varied in (("search", "bound"), ("bound", "search")):
        for (name,), part in groups(runs, [fixed], sort=True):
            kinds = sorted(part[varied].unique(), key=lambda kind: (kind == PUBLISHED, kind))
            if PUBLISHED not in kinds and varied == "bound":
                continue
            for other in kinds[:-1]:
                pair = [
                    part[part[varied] == kind].set_index("instance_id")
                    for kind in (kinds[-1], other)
                ]
                what = f"{varied} {kinds[-1]} / {other}; {fixed} {name}"
                rows.append([what, *_compared(*pair)])
    head = (
        "comparison", "instances", "difference of success rates", "ratio of mean RMSE",
        "ratio of mean assignments", "RMSE is", "assignments are",
    )  # fmt: skip
    return Shown(head, rows) if rows else None


def _compared(one: pd.DataFrame, other: pd.DataFrame) -> list[str]:
    other = other.loc[one.index]
    gained = estimate(np.subtract, one["success"], other["success"])
    error = estimate(np.divide, one["error"], other["error"])
    work = estimate(np.divide, one["n_assignments"], other["n_assignments"])
    return [
        str(len(one)), _change(gained), _shown(error), _shown(work),
        decision(error, 1.0), _decided_work(work, one, other),
    ]  # fmt: skip


def _decided_work(work: tuple[float, float, float], one: pd.DataFrame, other: pd.DataFrame) -> str:
    """Return the decision on a ratio of assignments; those of a run at a limit are a minimum."""
    found = decision(work, 1.0)
    cut = {"lower": one, "higher": other}.get(found)
    is_open = cut is not None and (cut["outcome"] == "limited").any()
    return f"open (limit; counts {found})" if is_open else found


def effect_of_n_inliers(measured: Measured) -> Shown | None:
    """Compare all and fewer given pairs for each method, on the same instances."""
    rows = []
    for (model, _), part in groups(measured.runs, ["model", "family"]):
        ratios = sorted(part["n_inliers_ratio"].unique(), reverse=True)
        if len(ratios) < 2:
            continue
        by_ratio = {
            ratio: part[part["n_inliers_ratio"] == ratio].set_index("instance_id")
            for ratio in ratios
        }
        common = by_ratio[ratios[0]].index
        for other in ratios[1:]:
            common = common.intersection(by_ratio[other].index)
        whole = by_ratio[ratios[0]].loc[common]
        for ratio in ratios:
            some = by_ratio[ratio].loc[common]
            wrong = some[~some["success"]]
            change = estimate(np.subtract, some["success"], whole["success"])
            rows.append([
                whole["display_name"].iloc[0], words_of(model), f"{ratio:g}", str(len(some)),
                share(some["success"]), share(some["certified"]),
                f"{(wrong['objective'] <= wrong['objective_true']).sum()} of {len(wrong)}",
                MISSING if ratio == ratios[0] else _change(change),
            ])  # fmt: skip
    head = (
        "method", "model", "n_p / true pairs", "instances", "success rate", CERTIFIED,
        "wrong poses with E ≤ E(reference)", "change of the success rate",
    )  # fmt: skip
    return Shown(head, rows) if rows else None


def norm_stage(measured: Measured) -> Shown | None:
    """Tabulate the error of translations that are certified optima in norm space, per test."""
    runs = measured.runs
    runs = runs[runs["certificate_scope"].isin(NORM_SCOPES) & runs["n_inliers_ratio"].eq(1)]
    first = searches(measured).drop_duplicates("run_id").set_index("run_id")
    lower, upper = (runs["run_id"].map(first[name]) for name in ("lower_bound", "upper_bound"))
    # a bound of 0 proves nothing, whatever the tolerance
    runs = runs.assign(ended=(lower > 0) & (upper - lower <= runs["gap_tol"] * (1 + 1e-9)))
    if not runs["ended"].any():
        return None
    rows = []
    for (name, test), part in groups(runs, ["display_name", "test"]):
        ended = part[part["ended"]]
        wrong = part["norm_translation_error"] > SUCCESS_SHARE
        error = part["norm_translation_error"].median()
        rows.append([
            name, words(test), _span(part["level"]), str(len(part)), str(len(ended)),
            share(wrong[part["ended"]]), share(wrong),
            number(round(error, 9), 2), share(~part["success"]),
        ])  # fmt: skip
    head = (
        "method", "test", "levels", "instances", "certified in norm space", "of these: wrong translation",
        "all runs: wrong translation",
        "all runs: median error of the translation", "all runs: wrong pose",
    )  # fmt: skip
    return Shown(head, rows)


def certified_wrong(measured: Measured) -> Shown | None:
    """Count certified optima of the pose objective that are wrong poses, per method and test."""
    runs = measured.runs[measured.runs["certified"]]
    rows = []
    keys = ["model", "n_inliers_ratio", "test"]
    # an optimum counts once, whoever certifies it
    for (model, ratio, test), part in groups(runs, keys):
        once = part.sort_values("upper_bound").drop_duplicates("instance_id")
        wrong = once[~once["success"]]
        lower = wrong["objective"] <= wrong["objective_true"]
        rows.append([
            words(test), words_of(model), ratio, _span(part["level"]), str(len(once)),
            share(~once["success"]), f"{lower.sum()} of {len(wrong)}",
        ])  # fmt: skip
    head = (
        "test", "model", "n_p / true pairs", "levels", "certified optima", "wrong poses",
        "of these: E ≤ E(reference)",
    )  # fmt: skip
    return Shown(head, rows) if rows else None


def searches(measured: Measured) -> pd.DataFrame:
    """Return the stages that bound boxes, without those that find initial poses."""
    return measured.stages[~measured.stages["stage"].str.startswith("start")]


def boxes_per_stage(measured: Measured) -> Shown | None:
    """Tabulate the boxes and assignments of each stage of a search."""
    stages = searches(measured).merge(measured.runs, on="run_id", suffixes=("", "_run"))
    if stages.empty:
        return None
    rows = []
    for (model, name, stage), part in groups(stages, ["model", "display_name", "stage"]):
        closed = (part["lower_bound"] / part["upper_bound"]).clip(0, 1)
        rows.append([
            name, words_of(model), stage, str(len(part)), _count(part["n_nodes"]),
            integer(part["n_nodes"].max()), _count(part["n_assignments"]), number(closed.median(), 2),
        ])  # fmt: skip
    head = (
        "method", "model", "stage", "runs", "median boxes", "maximum boxes", "median assignments",
        "median lower / upper bound",
    )  # fmt: skip
    return Shown(head, rows)


def options_of(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options in effect: the card's defaults and those given."""
    return {**card.get("parameters", {}), **card.get("options", {})}


def words_of(model: str) -> str:
    return {"similarity2d": "2D", "rigid3d": "3D"}.get(model, model)


def _count(values: pd.Series) -> str:
    return MISSING if values.isna().all() else integer(values.median())


def _span(values: pd.Series) -> str:
    return ", ".join(f"{value:g}" for value in sorted(values.unique()))
