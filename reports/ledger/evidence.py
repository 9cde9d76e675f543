"""The tables that claims are judged by: runs of experiments, and the study of bounds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from reports.tables import Tables, counted_time
from workflows.metrics import POSE_SCOPES
from workflows.outcomes import attempted

STUDY = "bounds"  # of which no runs are planned: its tables lie beside the experiments'
QUICK = "-quick"
_ROUNDING = 1e-12
LONGEST = (
    1.0  # errors in longest sides are capped there, which is also that of a run without a pose
)
SHORTEST = 1e-3  # below it, errors count as equal
FOR_EVER = 1e3  # times what a run took, of one that ended at a limit and might never have ended


@dataclass(frozen=True)
class Role:
    """A part that methods play in claims, and by what they are recognised in any experiment."""

    name: str
    title: str
    baseline: tuple[str, ...]
    n_inliers_ratio: float = 1.0
    options: Mapping[str, Sequence[Any]] = field(
        default_factory=dict
    )  # admitted values, best first
    without: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    every: bool = False  # all that fit take part; otherwise the best one

    def fit(self, card: Mapping[str, Any]) -> tuple[int, ...] | None:
        """Ranks of a method's baseline and options in this role; None: it does not play it."""
        options, baseline = card.get("options", {}), card.get("baseline")
        if baseline not in self.baseline or card.get("n_inliers_ratio", 1) != self.n_inliers_ratio:
            return None
        if any(options.get(key) in values for key, values in self.without.items()):
            return None
        if any(options.get(key) not in values for key, values in self.options.items()):
            return None
        ranks = [list(values).index(options.get(key)) for key, values in self.options.items()]
        extra = len(set(options) - set(self.options))  # plain methods before tuned ones
        return (self.baseline.index(baseline), *ranks, extra)


@dataclass(frozen=True)
class Experiment:
    """Runs of one experiment with the quantities that claims speak of."""

    tables: Tables

    @property
    def is_quick(self) -> bool:
        """Whether this is the quick part of the experiment that claims name."""
        return self.tables.experiment.endswith(QUICK)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Attempted runs with the quantities of claims, and of those at a limit which are ``settled``.

        A settled run found what is proven optimal, within its tolerance: more time would hardly
        change an error. Only runs whose bounds speak of the pose are, as only they search for it.
        """
        runs = attempted(self.tables.runs)
        scale = np.array([_scale(text) for text in runs["T_reference"]])
        sides = (runs["rmse_excess"] / scale).fillna(LONGEST)
        limited = runs["outcome"].eq("limited")
        violated = (runs["bound_violation"] > 0) | (
            runs["lower_bound"] > runs["objective_best"] * (1 + 1e-9) + 1e-12
        )
        worst = runs["rmse"].max()
        speaks = runs["certificate_scope"].isin(POSE_SCOPES)
        return runs.assign(
            error=sides.clip(SHORTEST, LONGEST),
            rmse=runs["rmse"].fillna(worst),
            rmse_most=worst,
            time=counted_time(runs, self.tables.cards),
            success=runs["success"].astype(float),
            wrong=~runs["success"].astype(bool),
            search_error=runs["verdict"].eq("search_error").astype(float),
            certified=(runs["status"].eq("optimal") & speaks),
            violation=(violated & speaks).astype(float),
            limited=limited,
            settled=limited & speaks & (runs["regret_at_most"] <= runs["gap_tol"] + _ROUNDING),
            source=runs["shape"].str.extract(r"^(sun3d|7-scenes|rgbd-scenes|bundlefusion|analysis)",
                                             expand=False).fillna(runs["dataset"]),
        )  # fmt: skip

    def playing(self, role: Role) -> list[str]:
        """Methods of the experiment that play `role` and were attempted, best first."""
        present = set(attempted(self.tables.runs)["method"])
        ranked = sorted(
            (rank, label)
            for label, card in self.tables.cards.items()
            if label in present and (rank := role.fit({"baseline": label, **card})) is not None
        )
        return [label for _, label in (ranked if role.every else ranked[:1])]


def imagined(runs: pd.DataFrame, most: np.ndarray) -> pd.DataFrame:
    """The runs as if those at a limit had gone on and come to the least, or `most`, that they could."""
    open_time = runs["limited"].to_numpy()
    open_pose = open_time & ~runs["settled"].to_numpy()
    ends: dict[str, tuple[Any, Any, np.ndarray]] = {
        "error": (SHORTEST, LONGEST, open_pose),
        "rmse": (SHORTEST, runs["rmse_most"], open_pose),
        "success": (0.0, 1.0, open_pose),
        "search_error": (0.0, 1.0, open_pose),
        "objective": (-np.inf, np.inf, open_pose),
        "time": (runs["time_solve_s"], FOR_EVER * runs["time"], open_time),
        "n_nodes": (runs["n_nodes"], FOR_EVER * runs["n_nodes"], open_time),
    }
    return runs.assign(
        **{
            name: runs[name].astype(float).mask(is_open, np.where(most, high, low))
            for name, (low, high, is_open) in ends.items()
        }
    )


@dataclass(frozen=True)
class Evidence:
    """All tables at hand: experiments by name, and tables of the study of bounds by name."""

    experiments: dict[str, Experiment]
    study: dict[str, pd.DataFrame]
    notes: tuple[str, ...] = ()  # which of several tables of an experiment were taken

    @classmethod
    def of_tables(cls, tables: Tables) -> Evidence:
        """The tables of one report, and those of the study of bounds beside them."""
        root = next(
            (p.parent for p in tables.directory.parents if p.name == tables.experiment), None
        )
        study = _read_study(root / STUDY) if root else {}
        return cls({_plain(tables.experiment): Experiment(tables)}, study)

    @classmethod
    def of_folders(cls, folders: Sequence[Path]) -> Evidence:
        """Tables below `folders`: results of experiments, or folders of such results.

        The folder of an experiment's own name goes before others with its tables, the whole of it before
        its quick part.
        """
        found: dict[str, tuple[Path, Tables]] = {}
        study: dict[str, pd.DataFrame] = {}
        notes = []
        places = [place for folder in folders for place in (folder, *sorted(folder.glob("*")))]
        tables = {
            place: Tables.load(place / "tables")
            for place in places
            if (place / "tables" / "accounting.csv").is_file()
        }
        for place in sorted(tables, key=lambda at: _rank(at, tables[at].experiment)):
            name = _plain(tables[place].experiment)
            taken, _ = found.setdefault(name, (place, tables[place]))
            if taken != place:
                notes.append(f"{name}: the tables of {taken} are judged, not those of {place}")
            elif place.name != tables[place].experiment:
                notes.append(f"{name}: the tables of {place}, a folder of another name, are judged")
        for place in sorted(places, key=lambda path: path.name.endswith(QUICK)):
            study = study or _read_study(place)
        experiments = {name: Experiment(own) for name, (_, own) in found.items()}
        return cls(experiments, study, tuple(notes))


def _rank(place: Path, experiment: str) -> tuple[bool, bool]:
    """Which of several folders with tables of one experiment goes first."""
    return place.name != experiment, experiment.endswith(QUICK)


def _plain(name: str) -> str:
    return name.removesuffix(QUICK)


def _read_study(folder: Path) -> dict[str, pd.DataFrame]:
    paths = {name: folder / f"{name}.csv" for name in ("boxes", "orders", "searches")}
    if not all(path.is_file() for path in paths.values()):
        return {}
    return {name: pd.read_csv(path) for name, path in paths.items()}


def _scale(text: str) -> float:
    """Scale of a reference pose: lengths over it are in units of the source."""
    pose = np.array(json.loads(text or "[]"), dtype=float)
    if pose.size == 0:
        return 1.0
    d = len(pose) - 1
    return float(abs(np.linalg.det(pose[:d, :d])) ** (1 / d))
