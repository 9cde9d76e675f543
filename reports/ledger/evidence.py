"""The tables that claims are checked against: runs of experiments, and the study of bounds."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import compute

from dcreg.names import POSE_SCOPES
from reports.tables import Tables, check_study, is_refuted, started_in
from workflows.blocks import EVIDENCE
from workflows.compose import QUICK
from workflows.outcomes import attempted, main_machine

SHARED = ["dataset", "shape", "trial"]  # identify the same trial at different levels
TRIAL = [*SHARED, "test"]  # identify the instances that share a pose: a trial
STUDY = "bounds"  # has no planned runs: its tables are next to those of the experiments
_TIER = re.compile(rf"-(\d+)(?:{QUICK})?$")  # experiments with another number of points
# Long texts of runs that no check reads.
UNUSED = ["T_target_source", "options", "message", "chunk_id", "instance_digest", "fingerprint"]
_SCANS = re.compile("sun3d|7-scenes|rgbd-scenes|bundlefusion|analysis")  # sources of scans
NO_POSE = 1.0  # error of a run without a pose, in longest sides
MIN_ERROR = 1e-3  # smaller errors count as equal


@dataclass(frozen=True)
class Role:
    """A role of methods in claims, and how they are recognised in any experiment.

    `options` are compared with the effective options of a run: the card's defaults and those given.
    """

    name: str
    title: str
    baseline: tuple[str, ...]
    n_inliers_ratio: float = 1.0
    options: Mapping[str, Sequence[Any]] = field(
        default_factory=dict
    )  # accepted values, best first
    # Options of which the truth is not known: a method per accepted value takes part, and verdicts on
    # which these do not agree stay open.
    choices: Sequence[str] = ()

    @property
    def n_choices(self) -> int:
        """Return the number of methods that must agree."""
        return math.prod(len(self.options[name]) for name in self.choices)

    def chosen(self, ranks: tuple[int, ...]) -> tuple[int, ...]:
        """Return those of the `ranks` of a run that belong to `choices`."""
        rank_of = dict(zip(self.options, ranks[1:], strict=True))
        return tuple(rank_of[name] for name in self.choices)

    def fit(
        self, baseline: str, options: Mapping[str, Any], n_inliers_ratio: float = 1.0
    ) -> tuple[int, ...] | None:
        """Return the ranks of a run's baseline and effective options; None if it does not fit."""
        if baseline not in self.baseline or n_inliers_ratio != self.n_inliers_ratio:
            return None
        ranks = [self.baseline.index(baseline)]
        for key, values in self.options.items():
            if key not in options or options[key] not in values:
                return None
            ranks.append(list(values).index(options[key]))
        return tuple(ranks)


@dataclass(frozen=True)
class Experiment:
    """Runs of one experiment with the quantities that claims refer to."""

    tables: Tables

    @property
    def is_quick(self) -> bool:
        """Whether this is the quick part of an experiment."""
        return self.tables.experiment.endswith(QUICK)

    @property
    def variables(self) -> str:
        """The variables of make that choose this part of the experiment."""
        tier = _TIER.search(self.tables.experiment)
        points = f" POINTS={tier[1]}" if tier else ""
        return points + " QUICK=1" * self.is_quick

    @cached_property
    def machine_id(self) -> str:
        """The machine of most runs; the times of others are not used."""
        return main_machine(self.tables.runs)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Attempted runs with the quantities of claims."""
        runs = attempted(self.tables.runs.drop(columns=UNUSED, errors="ignore"))
        scale = runs["T_reference"].map({t: _scale(t) for t in runs["T_reference"].unique()})
        source = runs["shape"].map(_scan_sources(runs["shape"]))
        of_pose = runs["certificate_scope"].isin(POSE_SCOPES)
        here = runs["machine_id"] == self.machine_id
        return runs.assign(
            error=(runs["rmse"] / scale).fillna(NO_POSE).clip(lower=MIN_ERROR),
            excess=(runs["rmse_excess"] / scale).fillna(NO_POSE).clip(lower=MIN_ERROR),
            floor=(runs["rmse_floor"] / scale).fillna(0.0),
            rmse=runs["rmse"].fillna(runs["rmse"].max()),
            time=_time(runs, self.tables.cards).where(here),
            success=runs["success"].astype(float),
            wrong=~runs["success"].astype(bool),
            search_error=runs["verdict"].eq("search_error").astype(float),
            certified=runs["status"].eq("optimal") & of_pose,
            open_gap=_open_gap(runs),
            # a lower bound of at most 0 proves nothing
            violation=is_refuted(runs).astype(float).where(of_pose & (runs["lower_bound"] > 0)),
            missed=_is_missed(runs).astype(float).where(_is_comparable(runs) & of_pose),
            limited=runs["outcome"].eq("limited"),
            **_translation(runs, self.tables.cards, here),
            source=source.where(source != "", runs["dataset"]),
            unit=_units(runs, source),
        )

    @cached_property
    def _rows_of(self) -> dict[str, np.ndarray]:
        """The positions of the runs of each method."""
        places = self.runs.groupby("method", sort=False).indices
        return {str(method): np.asarray(rows) for method, rows in places.items()}

    def of_method(self, method: str) -> pd.DataFrame:
        """Return the runs of a method."""
        return self.runs.iloc[self._rows_of.get(method, [])]

    def with_ids(self, run_ids: Iterable[str]) -> pd.DataFrame:
        """Return the runs with these values of ``run_id``, in the order of the table."""
        wanted = pa.array(list(run_ids), pa.string())
        # the same as `isin`, which takes ten times as long for many values
        found = compute.is_in(pa.array(self.runs["run_id"], pa.string()), value_set=wanted)
        return self.runs[found.to_numpy(zero_copy_only=False)]

    @cached_property
    def first(self) -> pd.DataFrame:
        """The first run of each method, indexed by it: what its runs have in common."""
        return self.runs.drop_duplicates("method").set_index("method")

    @cached_property
    def cells(self) -> pd.DataFrame:
        """Each test with each of its levels."""
        return self.runs[["test", "level"]].drop_duplicates()

    def methods_in(self, role: Role) -> list[str]:
        """Return the attempted methods of the experiment that fit `role`, best first."""
        options = [json.loads(text or "{}") for text in self.first["options_effective"]]
        settings = zip(
            self.first.index, self.first["baseline"], options, self.first["n_inliers_ratio"],
            strict=True,
        )  # fmt: skip
        return methods_in(role, settings)

    def planned_in(self, role: Role) -> list[str]:
        """Return the methods that fit `role`, best first: the attempted ones, else the available ones.

        If a role has several methods, those that were not attempted yet are included.
        """
        settings = [
            (name, str(card.get("baseline")), {**card.get("parameters", {}), **card.get("options", {})},
             float(card.get("n_inliers_ratio", 1.0)))
            for name, card in self.tables.cards.items() if not card.get("unavailable")
        ]  # fmt: skip
        tried, every = self.methods_in(role), methods_in(role, settings)
        return tried if len(tried) >= role.n_choices else list(dict.fromkeys([*tried, *every]))


def methods_in(
    role: Role, settings: Iterable[tuple[str, str, Mapping[str, Any], float]]
) -> list[str]:
    """Return the methods that fit `role`, best first.

    `settings` are name, baseline, effective options and n_inliers ratio of each method.
    """
    ranked = sorted(
        (rank, place, label)
        for place, (label, baseline, options, ratio) in enumerate(settings)
        if (rank := role.fit(baseline, options, ratio)) is not None
    )
    best: dict[tuple[int, ...], str] = {}
    for rank, _, label in ranked:
        best.setdefault(role.chosen(rank), label)
    return list(best.values())


def _units(runs: pd.DataFrame, source: pd.Series) -> pd.Series:
    """Return what is independent: the trials, whose instances share a pose; of scans, the instances."""
    trials = runs.groupby(TRIAL, sort=False).ngroup()
    pairs = pd.Series(-1 - pd.factorize(runs["instance_id"])[0], runs.index)
    return trials.where(source == "", pairs)


def _open_gap(runs: pd.DataFrame) -> pd.Series:
    """Return the share of the objective that is not proven: 0 for an exact fit, 1 without bounds.

    It is missing for methods that state no bounds.
    """
    is_bounding = runs["gap"].notna().groupby(runs["method"]).transform("any")
    proven = runs["bound_ratio"].mask(runs["gap"].isna(), 0.0)
    return (1.0 - proven).clip(0.0, 1.0).where(is_bounding)


def _time(runs: pd.DataFrame, cards: Mapping[str, Mapping[str, Any]]) -> pd.Series:
    """Return the seconds of runs: a run at a limit took at least these, one of unknown time its limit."""
    limits = runs["method"].map(
        {k: card.get("limits", {}).get("time_s") for k, card in cards.items()}
    )
    return runs["time_solve_s"].fillna(limits.astype(float))


def _translation(
    runs: pd.DataFrame, cards: Mapping[str, Mapping[str, Any]], here: pd.Series
) -> dict[str, pd.Series]:
    """Return the work without the rotation stage of methods that end with our reconstruction of one.

    Of other methods it is the whole work. Times are known for runs `here`, on the machine of most runs.
    """
    texts = runs.loc[runs["extra"].astype(str).str.contains("_translation", regex=False), "extra"]
    extra = [json.loads(text) for text in texts]

    def stated(name: str) -> pd.Series:
        found = [each.get(f"{name}_translation") for each in extra]
        return pd.Series(found, texts.index, float).reindex(runs.index)

    limited = runs["outcome"].eq("limited")
    return {
        "translation_time": stated("time_s").fillna(_time(runs, cards)).where(here),
        "translation_nodes": stated("n_nodes").fillna(runs["n_nodes"]),
        "translation_limited": stated("is_optimal")
        .map({0.0: True, 1.0: False})
        .fillna(limited)
        .astype(bool),
    }


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
        return cls({plain_name(tables.experiment): Experiment(tables)}, study)

    @classmethod
    def of_folders(cls, folders: Sequence[Path]) -> Evidence:
        """Return the tables below `folders`: results of experiments, or folders of such results.

        If an experiment has several tables, those in the folder of its name come first, then the whole
        experiment before its quick part, then all points before fewer points. Of collected evidence and
        of the runs of all trials, the one with more started runs comes first.
        """
        found: dict[str, tuple[Path, Tables]] = {}
        study: dict[str, pd.DataFrame] = {}
        notes = []
        places = [
            place
            for folder in folders
            for home in (folder, *sorted(folder.glob("*")))
            for place in sorted((home, home / EVIDENCE), key=started_in, reverse=True)
        ]
        tables = {
            place: Tables.load(place / "tables")
            for place in places
            if (place / "tables" / "accounting.csv").is_file()
        }
        for place in sorted(tables, key=lambda at: _rank(at, tables[at].experiment)):
            name = plain_name(tables[place].experiment)
            taken, _ = found.setdefault(name, (place, tables[place]))
            if taken != place:
                notes.append(f"{name}: the tables in {taken} are used, not those in {place}")
            elif _home(place) != tables[place].experiment:
                notes.append(f"{name}: the tables in {place}, a folder of another name, are used")
        for place in sorted(places, key=lambda path: path.name.endswith(QUICK)):
            study = study or _read_study(place)
        experiments = {name: Experiment(own) for name, (_, own) in found.items()}
        return cls(experiments, study, tuple(notes))


def _rank(place: Path, experiment: str) -> tuple[bool, bool, bool]:
    """Sort key of folders with tables of one experiment: the preferred one first."""
    return _home(place) != experiment, experiment.endswith(QUICK), bool(_TIER.search(experiment))


def _home(place: Path) -> str:
    """Return the name of the experiment whose results a folder holds."""
    return place.parent.name if place.name == EVIDENCE else place.name


def plain_name(name: str) -> str:
    """Return the name of an experiment without its number of points and its quick part."""
    return _TIER.sub("", name).removesuffix(QUICK)


def _read_study(folder: Path) -> dict[str, pd.DataFrame]:
    paths = {name: folder / f"{name}.csv" for name in ("boxes", "searches")}
    if not all(path.is_file() for path in paths.values()):
        return {}
    study = {name: pd.read_csv(path) for name, path in paths.items()}
    for table in study.values():
        check_study(table, folder)
    return study


def _is_comparable(runs: pd.DataFrame) -> pd.Series:
    """Tell whether an optimum is one over the poses of the problem.

    Algorithm 1 and some rivals also accept scales outside the range. Such a pose can have a lower
    objective than any pose of the problem.
    """
    return runs["status"].eq("optimal") & ~runs["admissible"].eq(False)


def _is_missed(runs: pd.DataFrame) -> pd.Series:
    """Tell whether a known pose is better by more than the tolerance."""
    return runs["upper_bound"] - runs["objective_best"] > runs["gap_tol"] * (1 + 1e-9)


def _scan_sources(shapes: pd.Series) -> dict[str, str]:
    """Return the source of each shape that is a scan; empty for others."""
    found = {shape: _SCANS.match(shape) for shape in shapes.unique()}
    return {shape: match[0] if match else "" for shape, match in found.items()}


def _scale(text: str) -> float:
    """Return the scale of a reference pose."""
    pose = np.array(json.loads(text or "[]"), dtype=float)
    if pose.size == 0:
        return 1.0
    d = len(pose) - 1
    return float(abs(np.linalg.det(pose[:d, :d])) ** (1 / d))
