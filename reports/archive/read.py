"""Read an archive: from its folder, a zip file or an address, checked by its checksums."""

from __future__ import annotations

import gzip
import re
import shutil
import zipfile
from pathlib import Path
from urllib.parse import urlsplit

import pandas as pd

from data.fetch import download
from dcreg.files import whole_file
from reports.tables import ReportError
from workflows import records
from workflows.archives import (
    ARCHIVES,
    CHECKSUMS,
    PROVENANCE,
    RUNS,
    TRACES,
    check,
    facts,
    is_inside,
    readable,
)  # fmt: skip
from workflows.blocks import EVIDENCE, NEEDS
from workflows.integrity import digest, sealed_file
from workflows.outcomes import stated
from workflows.stages.aggregate import accounting
from workflows.stages.clouds import CLOUDS

ADDRESSES = "http://", "https://"
MOST_DOWNLOADED, MOST_UNPACKED = 100_000_000, 200_000_000  # bytes of a zip file, and of its content
EXPERIMENT = r"[A-Za-z0-9][A-Za-z0-9._+-]*"


def folder_of(archive: str, cache: Path, sha256: str = "") -> Path:
    """Return the checked folder of an archive.

    Parameters
    ----------
    archive : str
        A version of `ARCHIVES`, a folder, a zip file, or an http(s) address of one.
    cache : Path
        Folder for downloaded and unpacked files.
    sha256 : str
        Of the zip file; required for an address.

    Raises
    ------
    ReportError
        There is no such archive, a file is damaged, or a zip file is unsafe.
    """
    if archive.startswith(ADDRESSES):
        archive = str(_download(archive, cache, sha256))
    path = next((p for p in (ARCHIVES / archive, Path(archive)) if p.exists()), None)
    if path is None:
        known = ", ".join(versions()) or "none"
        raise ReportError(f"{archive}: no such archive; stored versions: {known}")
    if sha256 and path.is_dir():
        raise ReportError(f"{archive}: a SHA-256 is that of a zip file, and this is a folder")
    if path.is_file():
        if sha256 and digest(path) != sha256:
            raise ReportError(f"{path}: SHA-256 is {digest(path)}, not {sha256}; get it again")
        path = _unzipped(path, cache)
    check(path)
    return path


def name_of(archive: str) -> str:
    """Return the name of an archive: that of its folder or file."""
    place = urlsplit(archive).path if archive.startswith(ADDRESSES) else Path(archive).absolute()
    return Path(place).name.removesuffix(".zip")


def versions() -> list[str]:
    """Return the stored versions, the latest last."""
    found = [path.parent for path in ARCHIVES.glob("*/archive.json")]
    created = {path.name: facts(path)["created"] for path in found}
    return sorted(created, key=lambda name: created[name])


def restore(folder: Path, out: Path, only: str = "") -> list[Path]:
    """Write the tables of an archive to ``out/EXPERIMENT/tables``; return these folders.

    They are those of the original results, with thinned bound histories. `only` names one experiment.
    """
    with readable(folder):
        wanted = [("experiment", "==", only)] if only else None
        runs = pd.read_parquet(folder / RUNS, filters=wanted)
        traces = pd.read_parquet(folder / TRACES, filters=wanted)
        places = []
        for name, own in runs.groupby("experiment", sort=False):
            if not re.fullmatch(EXPERIMENT, str(name)):  # it becomes the name of a folder
                raise ReportError(f"{folder}: unsafe name {name!r} of an experiment; do not use it")
            places.append(out / str(name) / "tables")
            events = traces[traces["experiment"] == name].merge(
                own[["run_id", "method", "instance_id"]], on="run_id", how="left"
            )
            _restore_one(folder / "experiments" / str(name), own, events, places[-1])
        for path in sorted(folder.glob("bounds/*.parquet")):
            (out / "bounds").mkdir(parents=True, exist_ok=True)
            pd.read_parquet(path).to_csv(out / "bounds" / f"{path.stem}.csv", index=False)
        if (path := folder / "bounds" / PROVENANCE).is_file():
            shutil.copyfile(path, out / "bounds" / PROVENANCE)
        for path in sorted(folder.glob(f"{EVIDENCE}/*.csv")):
            (out / EVIDENCE).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / EVIDENCE / path.name)
        return places


def _restore_one(stored: Path, runs: pd.DataFrame, events: pd.DataFrame, tables: Path) -> None:
    runs = records.conform(runs, records.runs_columns(), "runs")
    runs["status"] = [*map(stated, runs["status"], runs["bound_ratio"])]  # of earlier versions
    records.write(runs, tables / "runs.parquet")
    records.write(records.conform(events, records.TRACES, "traces"), tables / "traces.parquet")
    with sealed_file(tables / "accounting.csv") as part:
        accounting(runs).to_csv(part, index=False)
    _copied(stored / PROVENANCE, tables / PROVENANCE)
    overlays = gzip.decompress((stored / "overlays.json.gz").read_bytes())
    with sealed_file(tables / "overlays.json") as part:
        part.write_bytes(overlays)
    if (stored / CLOUDS).is_file():  # earlier archives have none
        _copied(stored / CLOUDS, tables / CLOUDS)
    if (stored / NEEDS).is_file():
        _copied(stored / NEEDS, tables.with_name(NEEDS))


def _copied(stored: Path, path: Path) -> None:
    with sealed_file(path) as part:
        shutil.copyfile(stored, part)


def _download(address: str, cache: Path, sha256: str) -> Path:
    if not sha256:
        raise ReportError(
            f"{address}: give the SHA-256 that was published with the file (--sha256, in make SHA256=...)"
        )
    path = cache / f"{sha256[:16]}.zip"
    if path.is_file() and digest(path) == sha256:
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with whole_file(path) as part:
            download(address, part, MOST_DOWNLOADED)
            if (found := digest(part)) != sha256:
                raise ReportError(f"{address}: SHA-256 is {found}, not {sha256}; not kept")
    except (OSError, OverflowError) as error:  # no connection, or too large
        raise ReportError(f"{address}: {error}") from error
    return path


def _unzipped(path: Path, cache: Path) -> Path:
    """Unpack a zip file that holds only plain files of a reasonable size inside its folder."""
    out = cache / digest(path)[:16]
    with readable(path), zipfile.ZipFile(path) as packed:
        members = [entry for entry in packed.infolist() if not entry.is_dir()]
        size = sum(entry.file_size for entry in members)
        if size > MOST_UNPACKED:
            raise ReportError(
                f"{path}: {size / 1e6:.0f} MB unpacked, more than {MOST_UNPACKED / 1e6:g}; if you trust "
                "the file, unpack it and give the folder"
            )
        for entry in members:
            is_link = (entry.external_attr >> 28) == 0xA
            if is_link or not is_inside(entry.filename):
                raise ReportError(f"{path}: unsafe member {entry.filename!r}; do not use this file")
        packed.extractall(out, members=members)
    roots = [found.parent for found in sorted(out.rglob(CHECKSUMS))]
    if not roots:
        raise ReportError(f"{path}: no {CHECKSUMS} inside; not an archive")
    return roots[0]
