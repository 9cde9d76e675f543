"""The build of the package: equal files give equal archives, whatever the checkout they are in."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
READ = [
    *(
        "pyproject.toml",
        "MANIFEST.in",
        "README.md",
        "LICENSE",
        "workflows/packaging/reproducible.py",
    ),
    *("dcreg/__init__.py", "dcreg/_version.py", "dcreg/py.typed"),
]
BUILD = (
    "import sys; sys.path.insert(0, 'workflows/packaging'); import reproducible as backend; "
    "print(backend.build_{kind}(sys.argv[1]))"
)


def checkout(folder: Path, date: int, rights: int) -> Path:
    """Copy what the build reads, with a small part of the library, as another checkout may have it."""
    for name in READ:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        copy = Path(shutil.copy(ROOT / name, folder / name))
        copy.chmod(rights)
        os.utime(copy, (date, date))
    return folder


def built(kind: str, project: Path, out: Path) -> Path:
    """Build an sdist or a wheel as `pip` and `build` do: by the backend, in its own process."""
    out.mkdir(exist_ok=True)
    environment = {key: value for key, value in os.environ.items() if key != "SOURCE_DATE_EPOCH"}
    subprocess.run(
        [sys.executable, "-c", BUILD.format(kind=kind), str(out)],
        cwd=project, check=True, capture_output=True, env=environment,
    )  # fmt: skip
    (made,) = out.glob("*.tar.gz" if kind == "sdist" else "*.whl")
    return made


@pytest.mark.parametrize("kind", ["sdist", "wheel"])
def test_two_checkouts_give_the_same_bytes(tmp_path: Path, kind: str) -> None:
    first = built(kind, checkout(tmp_path / "a", 1_700_000_000, 0o600), tmp_path / "first")
    second = built(kind, checkout(tmp_path / "b", 1_800_000_000, 0o664), tmp_path / "second")
    assert first.name == second.name
    assert (
        hashlib.sha256(first.read_bytes()).digest() == hashlib.sha256(second.read_bytes()).digest()
    )


def test_the_wheel_of_the_sdist_is_that_of_the_checkout(tmp_path: Path) -> None:
    project = checkout(tmp_path / "project", 1_700_000_000, 0o644)
    with tarfile.open(built("sdist", project, tmp_path / "out")) as sdist:
        sdist.extractall(tmp_path, filter="data")
    (unpacked,) = tmp_path.glob("dcreg-*")
    wheel = built("wheel", project, tmp_path / "out")
    assert built("wheel", unpacked, tmp_path / "again").read_bytes() == wheel.read_bytes()
    with zipfile.ZipFile(wheel) as file:
        assert file.testzip() is None
        assert {"dcreg/py.typed", "dcreg/_version.py"} <= set(file.namelist())
