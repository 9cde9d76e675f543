"""Learned methods: the user's checkout and weights, run in a child process with its own interpreter.

Options of the method locate the parts, or environment variables if an option is empty (here for the
folder ``dcp``):

- ``checkout``, ``DCREG_DCP_CHECKOUT``: folder of the authors' code;
- ``weights``, ``DCREG_DCP_WEIGHTS``: file of the trained network;
- ``python``, ``DCREG_DCP_PYTHON``: interpreter with the packages that the code needs; default: this one;
- ``device``, ``DCREG_DCP_DEVICE``: ``cpu`` (default), ``cuda``, ...

The child runs ``learned_child.py`` with the folder's ``runner.py``. It loads the network once, in the
warm-up, which is not timed. It then answers every line of JSON by one line of JSON:

- request ``{"input": FILE, "output": FILE}``; the input is an ``.npz`` with ``source`` (n, 3), ``target``
  (m, 3), ``n_inliers``, ``noise_bound`` and ``seed``;
- answer ``{"ok": true}`` and an output ``.npz`` with ``T_target_source`` (4, 4), or
  ``{"error": TEXT}``. The first answer is ``{"ready": true}`` or ``{"error": TEXT}``.

Output of the checkout is kept separate. The child ends when its input closes.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np

from baselines._shared.poses import rigid_pose
from baselines.contract import Baseline, Card, Instance, Limits, Solution, tiny
from dcreg.search import Budget
from dcreg.status import Status

CHILD = Path(__file__).with_name("learned_child.py")
PLACES = ("checkout", "weights", "python", "device")
LOADING_S = 600.0  # for imports and the network, in the warm-up


class ChildError(Exception):
    """The child died, or returned an error."""


class LearnedMethod(Baseline):
    """A method with a ``runner.py``; a subclass names the files that a checkout must have."""

    folder: Path  # of the method, with its runner.py
    expects: tuple[str, ...] = ()  # files that the checkout must have
    least_points: int = 1  # per cloud

    def __init__(self, card: Card, **options: Any) -> None:
        super().__init__(card, **options)
        self._child: Child | None = None

    def place(self, name: str) -> str:
        """Return the option, or the environment variable if the option is empty."""
        return str(self.options[name] or os.environ.get(self._variable(name), ""))

    def available(self) -> str | None:
        reason = self._missing()
        return None if reason is None else f"{reason}. {self.card.how_to_get}"

    def supports(self, instance: Instance) -> str | None:
        smaller = min(len(instance.source), len(instance.target))
        if instance.dim == 3 and smaller < self.least_points:
            name, least = self.card.display_name, self.least_points
            return f"{name} needs at least {least} points per cloud, got {smaller}"
        return super().supports(instance)

    def warm_up(self, instance: Instance) -> None:
        """Start the child and load the network; `solve` reports errors."""
        small = tiny(instance)
        if self.supports(small) is None:
            self.solve(small, Limits(time_s=LOADING_S))
        else:
            self.solve(instance, Limits(time_s=LOADING_S))

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        budget = limits.budget()
        if reason := self.available():
            return Solution(Status.UNAVAILABLE, None, reason)
        if reason := self.supports(instance):
            return Solution(Status.UNSUPPORTED, None, reason)
        try:
            if self._child is None:
                self._child = self._started(limits.threads)
            pose = self._child.register(instance, budget)
        except TimeoutError:
            self._drop_child()
            # reload the network before the next instance
            self._child = self._started(limits.threads)
            message = "no answer within the time limit; the pose is the identity"
            return Solution(Status.TIME_LIMIT, np.eye(4), message)
        except ChildError as error:
            self._drop_child()
            return Solution(Status.FAILED, None, str(error))
        if reason := _not_rigid(pose):
            return Solution(Status.FAILED, None, f"the method returned {reason}")
        return Solution(Status.CONVERGED, rigid_pose(pose))

    def _started(self, threads: int) -> Child:
        return Child(self.folder / "runner.py", self._settings(), threads)

    def _settings(self) -> dict[str, Any]:
        places = {name: self.place(name) for name in PLACES}
        places["checkout"] = str(Path(places["checkout"]).resolve())
        places["weights"] = str(Path(places["weights"]).resolve())
        return {**self.options, **places, "device": places["device"] or "cpu"}

    def _missing(self) -> str | None:
        """Return what is missing, by name of option and variable."""
        for name in ("checkout", "weights"):
            if not self.place(name):
                return f"no {name}: option {name} and variable {self._variable(name)} are empty"
        checkout, weights = Path(self.place("checkout")), Path(self.place("weights"))
        if not checkout.is_dir():
            return f"checkout {checkout} is not a folder"
        for file in self.expects:
            if not (checkout / file).is_file():
                return f"checkout {checkout} has no {file}"
        if not weights.is_file():
            return f"weights {weights} is not a file"
        python = self.place("python") or sys.executable
        if shutil.which(python) is None:
            return f"python {python} is not an executable interpreter"
        return None

    def _variable(self, name: str) -> str:
        return f"DCREG_{self.folder.name}_{name}".upper()

    def _drop_child(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


class Child:
    """The child process and the folder of exchanged files."""

    def __init__(self, runner: Path, settings: dict[str, Any], threads: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="dcreg-learned-")
        self._errors = Path(self._folder.name) / "stderr.txt"
        self._buffer = b""
        self._ready = False
        counts = {
            name: str(threads)
            for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        }
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [
                    settings["python"] or sys.executable,
                    CHILD,
                    runner.resolve(),
                    json.dumps(settings),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, **counts},
            )
        # also if the adapter is dropped without being closed
        self.close = weakref.finalize(self, _close, self._process, self._folder)

    def register(self, instance: Instance, budget: Budget) -> np.ndarray:
        """Return the pose from the child.

        Raises
        ------
        TimeoutError
            If the budget is over; the state of the child is then unknown.
        ChildError
            With the reason from the child.
        """
        if not self._ready:
            self._answer(budget)
            self._ready = True
        given, wanted = (Path(self._folder.name) / name for name in ("input.npz", "output.npz"))
        np.savez(
            given,
            source=instance.source,
            target=instance.target,
            n_inliers=instance.n_inliers,
            noise_bound=instance.noise_bound,
            seed=instance.seed,
        )
        wanted.unlink(missing_ok=True)
        request = json.dumps({"input": str(given), "output": str(wanted)}) + "\n"
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(request.encode())
            self._process.stdin.flush()
        except OSError:
            raise ChildError(self._death()) from None
        self._answer(budget)
        with np.load(wanted) as arrays:
            return np.array(arrays["T_target_source"])

    def _answer(self, budget: Budget) -> None:
        """Wait for the next answer; raise if it is an error."""
        assert self._process.stdout is not None
        stream = self._process.stdout.fileno()
        while b"\n" not in self._buffer:
            if budget.is_over or not select.select([stream], [], [], budget.left())[0]:
                raise TimeoutError
            part = os.read(stream, 65536)
            if not part:
                raise ChildError(self._death())
            self._buffer += part
        line, self._buffer = self._buffer.split(b"\n", 1)
        if error := json.loads(line).get("error"):
            raise ChildError(str(error))

    def _death(self) -> str:
        code = self._process.wait()
        words = self._errors.read_text(errors="replace").strip().splitlines()
        last = f": {words[-1]}" if words else ""
        return f"the method's process ended with code {code}{last}"


def _close(process: subprocess.Popen, folder: tempfile.TemporaryDirectory) -> None:
    process.kill()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()
    process.wait()
    folder.cleanup()


def _not_rigid(pose: np.ndarray) -> str | None:
    """Return None for a rigid pose (to single precision), otherwise what the array is."""
    if pose.shape != (4, 4):
        return f"an array of shape {pose.shape}, not (4, 4)"
    if not np.isfinite(pose).all():
        return "a pose that is not finite"
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        return "a matrix whose linear part is not a rotation"
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        return f"a matrix with last row {pose[3].tolist()}"
    return None
