"""The origin of results: machine, versions, state of the checkout."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from workflows import CHECKOUT, integrity
from workflows.hashing import digest

PACKAGES = [
    "numpy",
    "scipy",
    "numba",
    "pandas",
    "pyarrow",
    "open3d",
    "open3d-cpu",
    "pycpd",
    "kiss_matcher",
    "kiss-icp",
    "small_gicp",
    "teaserpp_python",
    "clarabel",
    "snakemake",
    "plotly",
]

LOCK = CHECKOUT / "requirements.lock"
_CODE = ("dcreg", "baselines", "data", "workflows", "reports")


@cache
def machine_card() -> dict[str, Any]:
    """Return the facts of the machine that determine run times, without names of host or user."""
    import psutil

    card = {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 2**30),
        "system": platform.system(),
        "architecture": platform.machine(),
        "python": ".".join(platform.python_version_tuple()[:2]),
    }
    return {**card, "machine_id": digest(card, 8)}


def versions() -> dict[str, str]:
    """Return the versions of the relevant packages; missing ones are marked."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def git_state() -> dict[str, Any]:
    """Return the commit, whether the code differs from it, and which files it lacks; empty outside git.

    A new file in a folder of code, such as an uncommitted method, is a difference.
    """
    commit = _git("rev-parse", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    new = _git("ls-files", "--others", "--exclude-standard", "--", *_CODE)
    untracked = new.splitlines() if new else []
    return {"commit": commit or "", "dirty": bool(changed or untracked), "untracked": untracked}


def origin() -> dict[str, Any]:
    """Return what results depend on besides their config: machine, code and packages."""
    return {
        "machine": machine_card(),
        "versions": versions(),
        "git": git_state(),
        "lock_sha256": integrity.digest(LOCK) if LOCK.is_file() else "",
        "created": now(),
    }


def default_version() -> str:
    """Return the name for recorded results: from ``git describe``, or the version of the library."""
    from dcreg._version import __version__

    described = _git("describe", "--always", "--dirty", "--tags")
    return f"{__version__}-{described}" if described else __version__


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=CHECKOUT, capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
