"""A method that looks for the ground truth in the working folder and the checkout, and for secrets.

`Solution.extra` states for each attempt whether it succeeded: 1 or 0.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np

from baselines import registry
from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.status import Status

PARENT = Path("/proc", str(os.getppid()))


def _truth() -> Path:
    """Return a file of ground truth; folders can be listed."""
    return next(Path.cwd().glob("results/*/truth/*.npz"))


def _reads(path: Path) -> bool:
    with np.load(path) as arrays:
        return bool(arrays.files)


def by_its_name() -> bool:
    return _reads(_truth())


def by_a_child() -> bool:
    code = "import sys; open(sys.argv[1], 'rb').read(1)"
    return not subprocess.run([sys.executable, "-c", code, _truth()], stderr=-3).returncode


def by_a_symbolic_link() -> bool:
    link = Path(tempfile.mkdtemp(), "link.npz")
    link.symlink_to(_truth())
    return _reads(link)


def by_a_hard_link() -> bool:
    link = Path(tempfile.mkdtemp(), "link.npz")
    os.link(_truth(), link)
    return _reads(link)


def by_the_parent() -> bool:
    return _reads(Path(f"{PARENT}/root{_truth()}"))


def by_new_rights() -> bool:
    _truth().chmod(0o777)
    return _reads(_truth())


def changes_it() -> bool:
    with _truth().open("ab") as file:
        return file.write(b"x") == 1


def deletes_it() -> bool:
    _truth().unlink()
    return True


def has_a_secret() -> bool:
    return "A_PASSWORD" in os.environ or "DCREG_DATA_MIRROR" in os.environ


def by_the_problem_library() -> bool:
    library = Path(registry.__file__).parents[1] / "data" / "library"
    found = []
    for folder in ("problems", "records", "proofs"):
        with suppress(OSError):
            found.append(next((library / folder).glob("*.*")).read_bytes())
    return bool(found)


def has_the_environment_of_the_parent() -> bool:
    return bool((PARENT / "environ").read_bytes())


ATTEMPTS = (
    by_its_name, by_a_child, by_a_symbolic_link, by_a_hard_link, by_the_parent, by_new_rights,
    by_the_problem_library, has_a_secret, has_the_environment_of_the_parent, changes_it, deletes_it,
)  # fmt: skip


class Adapter(Baseline):
    def warm_up(self, instance: Instance) -> None:
        """Nothing: a second attempt would find the file deleted."""

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        extra = {}
        for attempt in ATTEMPTS:
            try:
                extra[attempt.__name__] = float(attempt())
            except OSError:
                extra[attempt.__name__] = 0.0
        return Solution(Status.CONVERGED, np.eye(instance.dim + 1), extra=extra)
