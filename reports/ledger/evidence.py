"""The tables that claims are checked against: runs of experiments, and the study of bounds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dcreg.names import POSE_SCOPES
from reports.tables import Tables, check_study, counted_time
from workflows.outcomes import attempted

STUDY = "bounds"  # has no planned runs: its tables are next to those of the experiments
QUICK = "-quick"
_ROUNDING = 1e-12
MAX_ERROR = 1.0  # longest sides: larger errors, and those of runs without a pose, count as this
MIN_ERROR = 1e-3  # smaller errors count as equal
UNLIMITED = 1e3  # factor of the time that a run at a limit may take without one


@dataclass(frozen=True)
class Role:
    """A role of methods in claims, and how they are recognised in any experiment."""

    name: str
    title: str
    baseline: tuple[str, ...]
    n_inliers_ratio: float = 1.0
    options: Mapping[str, Sequence[Any]] = field(
        default_factory=dict
    )  # accepted values, best first
    without: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    every: bool = False  # all that fit take part; otherwise the best one

    def fit(self, card: Mapping[str, Any]) -> tuple[int, ...] | None:
        """Return the ranks of a method's baseline and options in this role; None if it does not fit."""
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
    """Runs of one experiment with the quantities that claims refer to."""

    tables: Tables

    @property
    def is_quick(self) -> bool:
        """Whether this is the quick part of an experiment."""
        return self.tables.experiment.endswith(QUICK)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Attempted runs with the quantities of claims.

        A run at a limit is ``settled`` if its pose is proven optimal within its tolerance: more time
        would hardly change its error. This applies only to runs with bounds on the objective of the pose.
        """
        runs = attempted(self.tables.runs)
        scale = np.array([_scale(text) for text in runs["T_reference"]])
        sides = (runs["rmse_excess"] / scale).fillna(MAX_ERROR)
        limited = runs["outcome"].eq("limited")
        violated = (runs["bound_violation"] > 0) | (
            runs["lower_bound"] > runs["objective_best"] * (1 + 1e-9) + 1e-12
        )
        worst = runs["rmse"].max()
        of_pose = runs["certificate_scope"].isin(POSE_SCOPES)
        return runs.assign(
            error=sides.clip(MIN_ERROR, MAX_ERROR),
            rmse=runs["rmse"].fillna(worst),
            rmse_max=worst,
            time=counted_time(runs, self.tables.cards),
            success=runs["success"].astype(float),
            wrong=~runs["success"].astype(bool),
            search_error=runs["verdict"].eq("search_error").astype(float),
            certified=(runs["status"].eq("optimal") & of_pose),
            violation=(violated & of_pose).astype(float),
            limited=limited,
            settled=limited & of_pose & (runs["regret_at_most"] <= runs["gap_tol"] + _ROUNDING),
            source=runs["shape"].str.extract(r"^(sun3d|7-scenes|rgbd-scenes|bundlefusion|analysis)",
                                             expand=False).fillna(runs["dataset"]),
        )  # fmt: skip

    def methods_in(self, role: Role) -> list[str]:
        """Return the attempted methods of the experiment that fit `role`, best first."""
        present = set(attempted(self.tables.runs)["method"])
        ranked = sorted(
            (rank, label)
            for label, card in self.tables.cards.items()
            if label in present and (rank := role.fit({"baseline": label, **card})) is not None
        )
        return [label for _, label in (ranked if role.every else ranked[:1])]


def hypothetical(runs: pd.DataFrame, at_maximum: np.ndarray) -> pd.DataFrame:
    """Return the runs with the extreme results that those at a limit could reach without it.

    `at_maximum` selects the runs that reach the maximum; the others reach the minimum.
    """
    open_time = runs["limited"].to_numpy()
    open_pose = open_time & ~runs["settled"].to_numpy()
    ends: dict[str, tuple[Any, Any, np.ndarray]] = {
        "error": (MIN_ERROR, MAX_ERROR, open_pose),
        "rmse": (MIN_ERROR, runs["rmse_max"], open_pose),
        "success": (0.0, 1.0, open_pose),
        "search_error": (0.0, 1.0, open_pose),
        "objective": (-np.inf, np.inf, open_pose),
        "time": (runs["time_solve_s"], UNLIMITED * runs["time"], open_time),
        "n_nodes": (runs["n_nodes"], UNLIMITED * runs["n_nodes"], open_time),
    }
    return runs.assign(
        **{
            name: runs[name].astype(float).mask(is_open, np.where(at_maximum, high, low))
            for name, (low, high, is_open) in ends.items()
        }
    )


@dataclass(frozen=True)
class Evidence:
    """All available tables: experiments by name, and tables of the study of bounds by name."""

    experiments: dict[str, Experiment]
    study: dict[str, pd.DataFrame]
    notes: tuple[str, ...] = ()  # which of several tables of an experiment are used

    @classmethod
    def of_tables(cls, tables: Tables) -> Evidence:
        """Return the tables of one report, and those of the study of bounds next to them."""
        root = next(
            (p.parent for p in tables.directory.parents if p.name == tables.experiment), None
        )
        study = _read_study(root / STUDY) if root else {}
        return cls({_plain(tables.experiment): Experiment(tables)}, study)

    @classmethod
    def of_folders(cls, folders: Sequence[Path]) -> Evidence:
        """Return the tables below `folders`: results of experiments, or folders of such results.

        Of several tables of an experiment, those in the folder of its name are preferred, then the whole
        experiment to its quick part.
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
                notes.append(f"{name}: the tables in {taken} are used, not those in {place}")
            elif place.name != tables[place].experiment:
                notes.append(f"{name}: the tables in {place}, a folder of another name, are used")
        for place in sorted(places, key=lambda path: path.name.endswith(QUICK)):
            study = study or _read_study(place)
        experiments = {name: Experiment(own) for name, (_, own) in found.items()}
        return cls(experiments, study, tuple(notes))


def _rank(place: Path, experiment: str) -> tuple[bool, bool]:
    """Sort key of folders with tables of one experiment: the preferred one first."""
    return place.name != experiment, experiment.endswith(QUICK)


def _plain(name: str) -> str:
    return name.removesuffix(QUICK)


def _read_study(folder: Path) -> dict[str, pd.DataFrame]:
    paths = {name: folder / f"{name}.csv" for name in ("boxes", "orders", "searches")}
    if not all(path.is_file() for path in paths.values()):
        return {}
    study = {name: pd.read_csv(path) for name, path in paths.items()}
    check_study(study["searches"], folder)
    return study


def _scale(text: str) -> float:
    """Return the scale of a reference pose."""
    pose = np.array(json.loads(text or "[]"), dtype=float)
    if pose.size == 0:
        return 1.0
    d = len(pose) - 1
    return float(abs(np.linalg.det(pose[:d, :d])) ** (1 / d))
