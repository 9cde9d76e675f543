"""Metadata of an archive in the form of RO-Crate, for programs that index research data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from rocrate.rocrate import ROCrate

from reports.tables import ReportError
from workflows.archives import files_in

METADATA = "ro-crate-metadata.json"
_UNDESCRIBED = {METADATA, "checksums.sha256"}
LICENCE = "https://spdx.org/licenses/MIT"
FORMATS = {
    ".parquet": "application/vnd.apache.parquet",
    ".json": "application/json",
    ".gz": "application/gzip",
    ".yaml": "application/yaml",
    ".cff": "application/yaml",
    ".md": "text/markdown",
    ".py": "text/x-python",
    ".csv": "text/csv",
}
MEANINGS = {
    "archive.json": "Version, schema, lock file and experiments of this archive",
    "runs.parquet": "One row per planned run, started or not; workflows/records.py documents the columns",
    "traces.parquet": "Bound histories of the runs, thinned",
    "provenance.json": "Machine, code and versions of an experiment, with its config, or of a study",
    "needs.json": "Numbers of trials that were run, per test and method",
    "overlays.json.gz": "Points and poses of the best, median and worst runs",
    "clouds.parquet": "Clouds of the instances of an experiment, rounded and thinned",
    "config.yaml": "Config that repeats an experiment",
    "REPEAT.md": "How to repeat and cite the experiments",
    "CITATION.cff": "How to cite the benchmark",
    "forecast.csv": "Forecast and actual run time of each step of evidence",
    "verdicts.csv": "Verdicts on the claims after 1, 2, 4, ... hours of run time, by the present rule",
    "open.csv": "Verdicts on the claims; expected hours of run time and obstacle of the open ones",
    "steps.csv": "Step of evidence, a pilot or one or more blocks, in which each run ended",
}
ENDINGS = {
    ".times.csv": "Measured times of a method per test and level",
}


def describe(folder: Path, facts: Mapping[str, Any]) -> None:
    """Write the metadata of all files in `folder`, but not of themselves and of the checksums."""
    crate = ROCrate()
    crate.name = f"Results of the DC-Reg benchmark, version {facts['version']}"
    crate.description = (
        f"{sum(each['started'] for each in facts['experiments'].values())} runs of "
        f"{len(facts['experiments'])} experiments on point cloud registration, with bound histories"
    )
    crate.license = LICENCE
    crate.datePublished = facts["created"]
    for name in _described(folder):
        path = folder / name
        properties = {
            "name": name,
            "description": _meaning(name),
            "encodingFormat": FORMATS.get(path.suffix, "application/octet-stream"),
            "contentSize": str(path.stat().st_size),
        }
        crate.add_file(str(path), dest_path=name, properties=properties)
    crate.metadata.write(folder)


def _described(folder: Path) -> list[str]:
    return sorted(files_in(folder) - _UNDESCRIBED)


def _meaning(name: str) -> str:
    if meaning := MEANINGS.get(PurePosixPath(name).name):
        return meaning
    for ending, meaning in ENDINGS.items():
        if name.endswith(ending):
            return meaning
    is_code = {"baselines", "data", "packages"} & set(PurePosixPath(name).parts)
    return "Code or card of a method or dataset" if is_code else "Table of the study of bounds"


def check(folder: Path) -> None:
    """Refuse metadata that the library cannot read, or that misses a file.

    Raises
    ------
    ReportError
    """
    try:
        crate = ROCrate(folder)
    except (ValueError, KeyError, OSError, TypeError, AttributeError) as error:
        raise ReportError(f"{folder / METADATA}: not valid: {error}") from error
    described = {entity.id for entity in crate.data_entities}
    present = set(_described(folder))
    for name in sorted(described ^ present):
        what = "is not described" if name in present else "is missing"
        raise ReportError(f"{folder / METADATA}: {name} {what}; write the archive again")
