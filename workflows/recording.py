"""Record the results of a version in ``reports/history/VERSION/EXPERIMENT``, and read them again.

A record has two files. ``runs.parquet`` is the small table of all runs: identity, status, work counters,
quality, integrals (`workflows.integrals`) and times. ``about.json`` has what another person needs to run
them again: config, code of each method, hash of the lock file, packages, commit and machine card.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from baselines import registry
from dcreg.files import whole_file
from workflows import CHECKOUT, HISTORY, UserError, provenance, records
from workflows.config import search_next_to
from workflows.integrals import COLUMNS, integrals
from workflows.integrity import refuse_damaged

if TYPE_CHECKING:
    import pandas as pd

RUNS, ABOUT = "runs.parquet", "about.json"
MOST_BYTES = 100_000  # of a record in the checkout, which is committed
_COPIED = (
    "schema_version",
    "experiment",
    "config",
    "machine",
    "versions",
    "git",
    "created",
    "commands",
)
_REQUIRED = ("rmse", "objective", "success")  # metrics that every record has


class RecordError(UserError):
    """Results cannot be recorded or compared; the message names file, value and remedy."""


@dataclass(frozen=True)
class Record:
    """The runs of one experiment under one version, and where they come from."""

    runs: pd.DataFrame
    about: dict[str, Any]


def columns() -> dict[str, records.Column]:
    """Return the columns of a record."""
    return records.recorded_columns() | COLUMNS


def of_results(folder: Path) -> Record:
    """Return the record of a folder of results.

    Raises
    ------
    RecordError, SchemaError, DamagedError
    """
    refuse_damaged(folder / "tables")
    runs = records.read(folder / "tables" / "runs.parquet", records.runs_columns())
    traces = records.read(folder / "tables" / "traces.parquet", records.TRACES)
    known = json.loads((folder / "tables" / "provenance.json").read_text(encoding="utf-8"))
    if known["selection"]:
        raise RecordError(
            f"{folder}: contains a part of the experiment ({known['selection']}); "
            "run and record the whole experiment"
        )
    runs = runs.join(integrals(runs, traces))
    about = {key: known[key] for key in _COPIED if key in known}
    if config_file := known.get("config_file"):
        search_next_to(CHECKOUT / config_file)
    is_own = known["git"]["commit"] == provenance.git_state()["commit"]
    about |= {
        "lock_sha256": known.get("lock_sha256", ""),
        "methods": {
            name: {
                **{
                    key: card.get(key) for key in ("baseline", "display_name", "version", "options")
                },
                **{key: card.get(key) for key in ("deterministic", "n_inliers_ratio", "limits")},
                "fingerprint": _fingerprint(runs, name),
                "code": registry.code_hash(card["baseline"]) if is_own else "",
            }
            for name, card in known["methods"].items()
        },
    }
    return Record(runs[list(columns())], about)


def _fingerprint(runs: pd.DataFrame, method: str) -> str:
    return ", ".join(sorted(set(runs.loc[runs["method"] == method, "fingerprint"])))


def find(result: str, results: Path = Path("results")) -> Path:
    """Return the folder of results with this name or path.

    Raises
    ------
    RecordError
    """
    for folder in (Path(result), results / result):
        if (folder / "tables" / RUNS).is_file():
            return folder
    known = sorted(path.parents[1].name for path in results.glob(f"*/tables/{RUNS}"))
    raise RecordError(
        f"no results of {result!r}; available: {', '.join(known) or 'none'}. "
        f"Make them with `python -m workflows run {result}`"
    )


def record(folder: Path, history: Path = HISTORY, version: str = "") -> Path:
    """Store the record of a folder of results under a version; return the new folder.

    Raises
    ------
    RecordError, SchemaError
    """
    found = of_results(folder)
    version = version or provenance.default_version()
    out = history / version / found.about["experiment"]
    out.mkdir(parents=True, exist_ok=True)
    with whole_file(out / RUNS) as part:
        found.runs.to_parquet(part, index=False, compression="zstd", compression_level=19)
        if history == HISTORY and (size := part.stat().st_size) > MOST_BYTES:
            raise RecordError(
                f"{folder}: its record has {size / 1e3:.0f} kB, but those in {HISTORY} are committed and "
                f"have at most {MOST_BYTES / 1e3:.0f} kB; record it with --history FOLDER"
            )
    about = {"version": version, **found.about}
    with whole_file(out / ABOUT) as part:
        part.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return out


def versions(history: Path = HISTORY) -> list[str]:
    """Return the recorded versions, the earliest first."""
    dates: dict[str, str] = {}
    for path in history.glob(f"*/*/{ABOUT}"):
        created = str(_about(path).get("created", ""))
        version = path.parents[1].name
        dates[version] = min(dates.get(version, created), created)
    return sorted(dates, key=lambda version: (dates[version], version))


def read(name: str, history: Path = HISTORY) -> dict[str, Record]:
    """Read the records of a version, or of a folder of records or results, by experiment.

    Raises
    ------
    RecordError, SchemaError
    """
    if (Path(name) / "tables" / RUNS).is_file():
        found = of_results(Path(name))
        return {found.about["experiment"]: found}
    folder = history / name if (history / name).is_dir() else Path(name)
    paths = sorted(folder.glob(f"*/{RUNS}"))
    if not name or not paths:
        raise RecordError(
            f"no records of {name!r} in {history}; known: {', '.join(versions(history)) or 'none'}. "
            f"Make them with `make record VERSION={name or 'NAME'}`, or name a folder of results"
        )
    return {path.parent.name: _read(path) for path in paths}


def _read(path: Path) -> Record:
    import pandas as pd

    about = _about(path.with_name(ABOUT))
    commit = about.get("git", {}).get("commit")
    at_commit = f" at commit {commit}" if commit else ""
    remedy = f"run and record the experiment again{at_commit}"
    records.check_version(about.get("schema_version"), str(path), remedy)
    try:
        table = pd.read_parquet(path)
    except (OSError, ValueError) as error:  # of PyArrow, for a damaged file
        raise RecordError(f"{path}: not a readable table ({error}); record it again") from error
    known = records.PLAN | records.RAW
    required = [name for name, column in known.items() if column.recorded] + list(_REQUIRED)
    if missing := [name for name in required if name not in table]:
        raise RecordError(f"{path}: column {missing[0]!r} is missing; record it again")
    return Record(table.reindex(columns=list(columns())), about)  # later metrics are empty


def _about(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: not readable ({error}); record the version again") from error
    if not isinstance(content, dict):
        raise RecordError(f"{path}: must hold an object; record the version again")
    return content
