"""Write an archive from the tables of experiments."""

from __future__ import annotations

import dataclasses
import gzip
import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from dcreg.files import whole_file
from reports.archive import clouds
from reports.archive.crate import describe
from reports.archive.read import restore
from reports.archive.sources import public, write_readme, write_sources
from reports.ledger.evidence import STUDY
from reports.tables import ReportError, Tables, started_in, thinned
from workflows import HISTORY, provenance, records
from workflows.archives import CHECKSUMS, FACTS, PROVENANCE, RUNS, TRACES, check
from workflows.blocks import EVIDENCE, NEEDS
from workflows.integrity import digest
from workflows.outcomes import STARTED

MOST_BYTES = 25_000_000  # of an archive
SHARE_BEFORE_CHECKSUMS = 0.9  # of these bytes: clouds fill what the tables leave
# Columns of a history that the runs have as well.
_SHARED = ["method", "instance_id"]


def write(
    results: Sequence[Path],
    out: Path,
    version: str,
    *,
    replace: bool = False,
    keep: bool = True,
) -> Path:
    """Write the archive of all results in `results` to the folder `out`, replacing an earlier one.

    Parameters
    ----------
    results : sequence of Path
        Folders that contain folders of results, each with ``tables/`` or tables of the study of bounds.
    out : Path
    version : str
    replace : bool
        Whether an experiment may have fewer results than in the earlier archive.
    keep : bool
        Whether experiments of the earlier archive without complete tables in `results` are kept, as
        after a stopped ``make evidence``.

    Raises
    ------
    ReportError
        There are no results, `version` is not a name, the archive would exceed `MOST_BYTES`, or results
        of the earlier one would be lost.
    """
    if not re.fullmatch(r"\w[\w.+-]*", version):  # it names a folder, which is replaced
        raise ReportError(f"version: {version!r}; use letters, digits, and . + - _ after the first")
    with tempfile.TemporaryDirectory() as earlier:
        if keep and (out / FACTS).is_file():
            check(out)
            restore(out, Path(earlier))
            if not replace:
                _refuse_fewer(results, Path(earlier), out)
        return _write(results, Path(earlier), out, version)


def _refuse_fewer(results: Sequence[Path], earlier: Path, out: Path) -> None:
    """Raise an error if an experiment has fewer results than in an archive."""
    new, old = _first_results(results), _first_results([earlier])
    for name in sorted(new.keys() & old.keys()):
        found, stored = _with_tables(new[name]), _with_tables(old[name])
        if found is None or stored is None:
            continue
        few, many = (started_in(place) for place in (found, stored))
        if few < many:
            raise ReportError(
                f"{found}: {few} runs of {name} ended, but {out} contains {many}, which would be lost; "
                "choose another name (--version, in make VERSION=mine), or pass --replace (REPLACE=1)"
            )


def _write(results: Sequence[Path], earlier: Path, out: Path, version: str) -> Path:
    """Write the archive of the first results of each experiment in these folders."""
    folders = list(_first_results([*results, earlier]).values())
    places = [found for place in folders if (found := _with_tables(place)) is not None]
    tables = [Tables.load(place / "tables") for place in places]
    if not tables:
        raise ReportError(f"{', '.join(map(str, results))}: no results; run an experiment first")
    shown = [dataclasses.replace(each, provenance=public(each.provenance)) for each in tables]
    part = out.with_name(f".{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    _write_tables(shown, part)
    for place, each in zip(places, tables, strict=True):
        if (needs := place / NEEDS).is_file():
            shutil.copyfile(needs, part / "experiments" / each.experiment / NEEDS)
    for place in folders:
        if place.name == STUDY:
            _write_study(place, part / STUDY)
    for path in _evidence(results, earlier):
        (part / EVIDENCE).mkdir(exist_ok=True)
        shutil.copyfile(path, part / EVIDENCE / path.name)
    added = {
        each.experiment: write_sources(each, part / "experiments" / each.experiment)
        for each in tables
    }
    facts = _facts(shown, version, _machines(shown, out))
    room = int(SHARE_BEFORE_CHECKSUMS * MOST_BYTES) - _size(part)
    for name, counts in clouds.write(tables, part, room).items():
        facts["experiments"][name]["clouds"] = counts
    provenances = {each.experiment: each.provenance for each in shown}
    write_readme(added, provenances, version, part)
    (part / FACTS).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    describe(part, facts)
    _write_checksums(part)
    if (size := _size(part)) > MOST_BYTES:
        raise ReportError(
            f"{part}: {size / 1e6:.1f} MB, more than {MOST_BYTES / 1e6:g}; archive fewer experiments"
        )
    shutil.rmtree(out, ignore_errors=True)
    part.rename(out)
    return out


def _evidence(results: Sequence[Path], earlier: Path) -> list[Path]:
    """Return the logs of evidence in `results`, and the times of other experiments; else earlier logs."""
    logs = next(filter(None, (sorted(root.glob(f"{EVIDENCE}/*.csv")) for root in results)), [])
    names = {path.name for path in logs}
    kept = sorted(earlier.glob(f"{EVIDENCE}/{'*.times' if logs else '*'}.csv"))
    return [*logs, *(path for path in kept if path.name not in names)]


def _first_results(roots: Sequence[Path]) -> dict[str, Path]:
    """Return the first folder with results by name, of experiments and of the study of bounds."""
    first: dict[str, Path] = {}
    for place in (place for root in roots for place in sorted(root.glob("*"))):
        if _with_tables(place) is not None or (place.name == STUDY and any(place.glob("*.csv"))):
            first.setdefault(place.name, place)
    return first


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _with_tables(place: Path) -> Path | None:
    """Return the folder of an experiment that has its tables.

    If it has several, of all its runs, of collected evidence, or of parts, the most started runs decide.
    """
    best = max((place / EVIDENCE, place, *sorted(place.glob("parts/*"))), key=started_in)
    return best if started_in(best) >= 0 else None


def _write_tables(tables: Sequence[Tables], out: Path) -> None:
    runs = pd.concat([each.runs for each in tables], ignore_index=True)
    traces = pd.concat(
        [thinned(each.traces).assign(experiment=each.experiment) for each in tables],
        ignore_index=True,
    )
    _store(runs, out / RUNS)
    _store(traces.drop(columns=_SHARED), out / TRACES)
    for each in tables:
        folder = out / "experiments" / each.experiment
        folder.mkdir(parents=True)
        (folder / PROVENANCE).write_text(json.dumps(each.provenance, indent=1), encoding="utf-8")
        packed = gzip.compress(json.dumps(each.overlays).encode(), mtime=0)
        (folder / "overlays.json.gz").write_bytes(packed)


def _write_study(place: Path, out: Path) -> None:
    for path in sorted(place.glob("*.csv")):
        out.mkdir(exist_ok=True)
        _store(pd.read_csv(path), out / f"{path.stem}.parquet")
    if (path := place / PROVENANCE).is_file():
        shutil.copyfile(path, out / PROVENANCE)


def _store(table: pd.DataFrame, path: Path) -> None:
    table.to_parquet(path, index=False, compression="zstd", compression_level=19)


def _facts(
    tables: Sequence[Tables], version: str, machines: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "version": version,
        "created": provenance.now(),
        "schema_version": records.SCHEMA_VERSION,
        "git": {key: value for key, value in provenance.git_state().items() if key != "untracked"},
        "machines": machines,
        "experiments": {
            each.experiment: {
                "title": each.provenance.get("config", {}).get("title", ""),
                "runs": len(each.runs),
                "started": int(each.runs["outcome"].isin(STARTED).sum()),
                "commands": each.provenance.get("commands", []),
                "lock_sha256": each.provenance.get("lock_sha256", ""),  # unknown in earlier tables
            }
            for each in tables
        },
    }


def _machines(tables: Sequence[Tables], out: Path) -> list[dict[str, Any]]:
    """Return the machines with their started runs; cards may be those of the archive that is replaced."""
    stored = (
        json.loads((out / FACTS).read_text("utf-8"))["machines"] if (out / FACTS).is_file() else []
    )
    records = sorted(HISTORY.glob("*/*/about.json"))
    cards = [
        *(card for card in stored if isinstance(card, dict)),  # earlier archives have names only
        *(json.loads(path.read_text("utf-8")).get("machine", {}) for path in records),
        *(each.provenance.get("machine", {}) for each in tables),
    ]
    known = {card.get("machine_id"): card for card in cards}
    started = pd.concat(
        [each.runs.loc[each.runs["outcome"].isin(STARTED), "machine_id"] for each in tables]
    )
    return [
        {"cpu": "unknown processor", **known.get(name, {}), "machine_id": name, "runs": int(runs)}
        for name, runs in started.value_counts().items()
    ]


def _write_checksums(out: Path) -> None:
    files = sorted(path for path in out.rglob("*") if path.is_file())
    lines = [f"{digest(path)}  {path.relative_to(out).as_posix()}\n" for path in files]
    (out / CHECKSUMS).write_text("".join(lines), encoding="utf-8")


def pack(folder: Path) -> Path:
    """Write an archive to a zip file next to it, the same bytes for the same files; return the file."""
    path = folder.with_name(f"{folder.name}.zip")
    with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as packed:
        for file in sorted(each for each in folder.rglob("*") if each.is_file()):
            name = f"{folder.name}/{file.relative_to(folder).as_posix()}"
            entry = zipfile.ZipInfo(name)  # of 1980
            entry.compress_type = zipfile.ZIP_DEFLATED
            packed.writestr(entry, file.read_bytes())
    return path
