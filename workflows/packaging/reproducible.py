"""Build sdists and wheels with setuptools, such that equal files give archives with equal hashes.

Entries have the date SOURCE_DATE_EPOCH or, without it, a fixed one. Owners and rights are fixed, because
they differ between checkouts.
"""

import gzip
import os
import tarfile
import zipfile
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 (all other hooks)

# setuptools reads it for the dates in wheels. The default is the first day of 2000.
EPOCH = int(os.environ.setdefault("SOURCE_DATE_EPOCH", "946684800"))


def build_sdist(sdist_directory: str, config_settings: Any = None) -> str:
    """Build an sdist whose entries have fixed dates, owners and rights."""
    path = Path(sdist_directory, build_meta.build_sdist(sdist_directory, config_settings))
    made = path.rename(path.with_suffix(".made"))
    with (
        tarfile.open(made) as old,
        gzip.GzipFile(path, "wb", mtime=EPOCH) as packed,
        tarfile.open(fileobj=packed, mode="w") as new,
    ):
        for entry in sorted(old, key=lambda entry: entry.name):
            fixed = tarfile.TarInfo(entry.name)
            fixed.type, fixed.size, fixed.mtime = entry.type, entry.size, EPOCH
            fixed.mode = 0o755 if entry.isdir() else 0o644
            new.addfile(fixed, old.extractfile(entry))
    made.unlink()
    return path.name


def build_wheel(
    wheel_directory: str, config_settings: Any = None, metadata_directory: Any = None
) -> str:
    """Build a wheel whose entries have fixed rights; setuptools sorts them and sets their dates."""
    name = build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
    path = Path(wheel_directory, name)
    with zipfile.ZipFile(path) as old:
        entries = [(entry, old.read(entry)) for entry in old.infolist()]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for entry, content in entries:
            entry.external_attr = 0o100644 << 16
            new.writestr(entry, content)
    return name
