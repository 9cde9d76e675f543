"""Fetch and verify files of a dataset: from the cache, then a mirror, then the official origin.

Environment
-----------
DCREG_DATA_CACHE
    Folder of the cache; by default ``resources`` in the checkout.
DCREG_DATA_MIRROR
    A folder or an http(s) address that contains the paths of the cards; tried before the origin.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from data.contract import DataError, File
from dcreg.files import whole_file

if TYPE_CHECKING:
    import requests

log = logging.getLogger(__name__)
CHECKOUT = Path(__file__).parents[1]
TIMEOUT_S = 30  # per connection and per silence, not per file
MOST_BYTES = 10**9  # of a file whose card states no size
PART_BYTES = 2**16  # that are written at once
_ORIGINS = ContextVar("origins", default=True)


class ChecksumError(DataError):
    """A file exists but differs from the one on the card."""


class SizeError(DataError):
    """A file is larger than the card states, or than any file may be."""


class UnavailableError(DataError):
    """A file is neither cached, nor in the mirror, nor reachable at its origin."""


def cache_root() -> Path:
    """Return the folder of fetched files."""
    return Path(os.environ.get("DCREG_DATA_CACHE") or CHECKOUT / "resources")


def cache_path(file: File) -> Path:
    """Return the path of this file in the cache, also for files that are put there manually."""
    return cache_root() / file.dataset / file.path


@contextmanager
def without_origins() -> Iterator[None]:
    """Fetch only from the cache and the mirror, for work that can do without the files."""
    token = _ORIGINS.set(False)
    try:
        yield
    finally:
        _ORIGINS.reset(token)


def fetch(file: File, *alternatives: File) -> Path:
    """Return the path of a verified local copy of `file`.

    Parameters
    ----------
    file : File
    *alternatives : File
        Alternative files (an original file if `file` is a pack of many). All are searched in the cache,
        then all in the mirror, then all at their origins.

    Raises
    ------
    ChecksumError, SizeError
        The file of the mirror or the origin differs from the card. It is not kept.
    UnavailableError
        No source could be reached; the message names address and path.
    """
    files = (file, *alternatives)
    tried: list[str] = []
    for step in (_from_cache, _from_mirror, _from_origin):
        for candidate in files:
            if path := step(candidate, tried):
                return path
    last = files[-1]
    raise UnavailableError(
        f"dataset {file.dataset}: {last.path} is not available here.\n"
        + "".join(f"  tried {line}\n" for line in tried)
        + f"Remedy: download {last.url or last.path} and put it at {cache_path(last)}, or set "
        "DCREG_DATA_MIRROR to a folder or address that holds the data."
    )


def _from_cache(file: File, tried: list[str]) -> Path | None:
    path = cache_path(file)
    if not path.is_file():
        return None
    stat = path.stat()
    found = _digest(path, file.git_sha1 is not None, stat.st_mtime_ns, stat.st_size)
    if found == _expected(file):
        return path
    # A damaged copy is replaced by a valid one; if there is none, the final error names it.
    tried.append(f"{path}: its checksum is {found}, expected {_expected(file)}")
    return None


def _from_mirror(file: File, tried: list[str]) -> Path | None:
    mirror = os.environ.get("DCREG_DATA_MIRROR")
    if not mirror:
        return None
    if mirror.startswith(("http://", "https://")):
        return _download(file, f"{mirror.rstrip('/')}/{quote(file.path)}", tried)
    folder = Path(mirror)
    if not folder.is_dir():
        raise DataError(
            f"DCREG_DATA_MIRROR={mirror} is not a folder; correct it or unset the variable"
        )
    origin = folder / file.path
    if not origin.is_file():
        tried.append(f"{origin}: no such file")
        return None
    if origin.stat().st_size > _most(file):
        raise _too_large(file, str(origin))
    return _place(file, str(origin), lambda part: shutil.copyfile(origin, part))


def _from_origin(file: File, tried: list[str]) -> Path | None:
    return _download(file, file.url, tried) if file.url and _ORIGINS.get() else None


def _download(file: File, url: str, tried: list[str]) -> Path | None:
    import requests  # only here: most runs find their files in the cache or in a folder

    log.info("fetching %s", url)
    try:
        return _place(file, url, lambda part: download(url, part, _most(file)))
    except requests.RequestException as error:
        tried.append(f"{url}: {_reason(error)}")
        return None
    except OverflowError:
        raise _too_large(file, url) from None


def download(url: str, path: Path, most: int) -> None:
    """Write the file at an http(s) address to `path`; stop after `most` bytes.

    Raises
    ------
    OverflowError
        The file is larger.
    requests.RequestException
        The address does not answer, or answers with an error.
    """
    import pooch

    downloader = pooch.HTTPDownloader(progressbar=False, chunk_size=PART_BYTES, timeout=TIMEOUT_S)
    with _Limited(path, most) as file:
        downloader(url, file, None)


class _Limited(io.FileIO):
    """A new file that takes only so many bytes: an answer may be endless, or unpack to much more."""

    def __init__(self, path: Path, most: int) -> None:
        super().__init__(path, "wb")
        self.most = most

    def write(self, part: Any) -> int:
        if self.tell() + len(part) > self.most:
            raise OverflowError(f"more than {self.most} bytes")
        return super().write(part)


def _most(file: File) -> int:
    return file.size or MOST_BYTES


def _too_large(file: File, origin: str) -> SizeError:
    stated = "the size on the card" if file.size else "the maximum for a card without a size"
    return SizeError(
        f"dataset {file.dataset}: {origin} has more than {_most(file)} bytes, {stated}; not kept\n"
        "Remedy: repair the mirror or unset DCREG_DATA_MIRROR; if the origin has changed, obtain the "
        f"file of the card and put it at {cache_path(file)}."
    )


def _reason(error: requests.RequestException) -> str:
    if error.response is not None:
        return f"HTTP status {error.response.status_code}"
    return f"{type(error).__name__} (no network, or the host does not answer)"


def _place(file: File, origin: str, write: Callable[[Path], object]) -> Path:
    """Write the file, and keep it only if its checksum is that of the card."""
    path = cache_path(file)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        write(part)
        found = _digest_of(part, git=file.git_sha1 is not None)
        if found != _expected(file):
            raise ChecksumError(
                f"dataset {file.dataset}: {origin} differs from the file on the card.\n"
                f"  expected {_expected(file)} ({file.size or 'unknown'} bytes)\n"
                f"  found    {found} ({part.stat().st_size} bytes); not kept\n"
                "Remedy: repair the mirror or unset DCREG_DATA_MIRROR; if the origin has changed, "
                f"obtain the file with that checksum and put it at {path}."
            )
    return path


def _expected(file: File) -> str:
    return f"sha256:{file.sha256}" if file.sha256 else f"git-sha1:{file.git_sha1}"


@lru_cache(maxsize=4096)
def _digest(path: Path, git: bool, mtime_ns: int, size: int) -> str:
    """`_digest_of`, once per process and state of the file."""
    return _digest_of(path, git)


def _digest_of(path: Path, git: bool) -> str:
    if git:  # git hashes a header with the length, then the content
        content = path.read_bytes()
        return "git-sha1:" + hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    with path.open("rb") as stream:
        return "sha256:" + hashlib.file_digest(stream, "sha256").hexdigest()
