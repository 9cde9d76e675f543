"""What a worker may see: a few environment variables, and no file of any result.

The environment is an allow-list. Files are protected by Landlock, a part of the Linux kernel that needs
no privileges: the process that loads a method, and all its children, can neither read nor write files
in `hidden_folders`. ``docs/security.md`` states what this does not cover.

``python -m workflows.stages.isolation FD [RULESET]`` gives up the rights and becomes the worker. It does
so before anything starts a thread: Landlock restricts the calling thread and what it starts later.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from workflows import CHECKOUT

# Variables that a worker receives, by name or by beginning.
PASSED = {
    "HOME", "LANG", "LANGUAGE", "LD_LIBRARY_PATH", "PATH", "TZ", "VIRTUAL_ENV", "XDG_CACHE_HOME",
}  # fmt: skip
PASSED_GROUPS = (
    "CUDA_", "DCREG_", "KMP_", "LC_", "MKL_", "NUMBA_", "NVIDIA_", "OMP_", "OPENBLAS_", "PYTHON",
)  # fmt: skip
# An address of the mirror can hold a password, and archives hold the poses of earlier runs.
WITHHELD = ("DCREG_ARCHIVES", "DCREG_DATA_")
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
RESULTS = (
    "results",
    "reports/history",
    "reports/archive",
)  # in the checkout and the working folder
# The best poses, true pairs and proofs of the problem library, in the checkout.
ANSWERS = ("data/library/problems", "data/library/records", "data/library/proofs")

# Numbers of the system calls, the same on all architectures that Numba supports.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_ONLY, _PATH_BENEATH = 1, 1
_DROP_CAPABILITY, _NO_NEW_PRIVILEGES = 24, 38  # of prctl
# Capabilities of root with which Landlock lets a process read the environment of any other.
_SYS_ADMIN, _PERFMON = 21, 38
# Rights over files and folders, one bit each; versions 2 and 3 of Landlock added the last two.
_WRITE_FILE, _READ_FILE, _REFER, _TRUNCATE = 1 << 1, 1 << 2, 1 << 13, 1 << 14
# All of the first version except to execute and to list: imports list the folders that they search.
_BASIC = (1 << 13) - 1 - (1 << 0) - (1 << 3)

_libc = ctypes.CDLL(None, use_errno=True)


class _PathBeneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("folder", ctypes.c_int32))


def environment(given: Mapping[str, str], threads: int, folder: Path) -> dict[str, str]:
    """Return the environment of a worker with a thread limit and `folder` for temporary files."""
    passed = {
        name: value
        for name, value in given.items()
        if (name in PASSED or name.startswith(PASSED_GROUPS)) and not name.startswith(WITHHELD)
    }
    path = [str(CHECKOUT), *filter(None, [given.get("PYTHONPATH")])]
    return {
        **passed,
        **dict.fromkeys(THREAD_VARIABLES, str(threads)),
        "PYTHONPATH": os.pathsep.join(path),
        "PYTHONHASHSEED": "0",
        "TMPDIR": str(folder),
    }


def hidden_folders() -> list[Path]:
    """Return the folders that hold ground truth and poses of other methods.

    Recorded datasets contain their poses, so copies of public data are hidden as well.
    """
    from data.fetch import cache_root

    archives = filter(None, os.environ.get("DCREG_ARCHIVES", "").split(os.pathsep))
    places = [place / name for place in (CHECKOUT, Path.cwd()) for name in RESULTS]
    places += [CHECKOUT / name for name in ANSWERS]
    places.append(cache_root())
    if (mirror := os.environ.get("DCREG_DATA_MIRROR", "")) and "://" not in mirror:
        places.append(Path(mirror))
    return list(dict.fromkeys(path.resolve() for path in (*places, *map(Path, archives))))


def ruleset(hidden: Iterable[Path]) -> int | None:
    """Return a file descriptor of the rights to everything outside `hidden`; None without Landlock.

    Landlock has no rules that forbid. Therefore each entry of a folder that contains a hidden one is
    allowed, except those that are, or contain, hidden ones. A file that is made there later is out of
    reach.
    """
    version = _call(_CREATE_RULESET, None, 0, _VERSION_ONLY) if sys.platform == "linux" else 0
    if version < 1:
        return None
    handled = _BASIC | (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    rules = _call(_CREATE_RULESET, ctypes.byref(ctypes.c_uint64(handled)), ctypes.c_size_t(8), 0)
    if rules < 0:
        return None
    for path in allowed(set(hidden)):
        try:
            place = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError:
            continue  # it is gone
        rights = handled if path.is_dir() else handled & (_READ_FILE | _WRITE_FILE | _TRUNCATE)
        rule = _PathBeneath(rights, place)
        _call(_ADD_RULE, rules, _PATH_BENEATH, ctypes.byref(rule), 0)
        os.close(place)
    return rules


def allowed(hidden: set[Path]) -> Iterator[Path]:
    """Yield the files and folders, links aside, that contain no hidden folder and are in none."""
    around = {folder for path in hidden for folder in path.parents}
    for folder in around - hidden:
        if any(parent in hidden for parent in folder.parents):
            continue
        with suppress(OSError):  # it does not exist, or cannot be listed
            for path in folder.iterdir():
                if path not in around and path not in hidden and not path.is_symlink():
                    yield path


def enforce(rules: int) -> None:
    """Give up all rights outside a ruleset, for what this process executes next.

    Raises
    ------
    OSError
    """
    for capability in (_SYS_ADMIN, _PERFMON):
        _libc.prctl(_DROP_CAPABILITY, capability, 0, 0, 0)  # fails for users who do not have it
    if _libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or _call(_RESTRICT_SELF, rules, 0):
        raise OSError(ctypes.get_errno(), "the ruleset cannot be enforced")
    os.close(rules)


def _call(number: int, *arguments: object) -> int:
    return int(_libc.syscall(number, *arguments))


if __name__ == "__main__":
    if sys.argv[2:]:
        enforce(int(sys.argv.pop()))
    os.execv(sys.executable, [sys.executable, "-m", "workflows.stages.worker", sys.argv[1]])
