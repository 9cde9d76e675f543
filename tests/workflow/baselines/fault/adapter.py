"""A method that goes wrong in a chosen way, on instances of 13 points and no others.

With the fault `any` it goes wrong on larger instances, each number of points in another way.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.search import Budget, Event
from dcreg.status import Status

UNLUCKY = 13
LONG_S = 3.0
LATE_S = 0.6
# Number of points -> what goes wrong with the fault `any`.
FAULTS = {
    20: "none", 21: "is_late", 22: "raises", 23: "hangs", 24: "bursts", 25: "exits",
    26: "is_killed", 27: "crashes", 28: "gives_no_pose", 29: "crosses_bounds", 30: "gives_up",
    31: "gives_nan", 32: "searches",
}  # fmt: skip


def take_token(folder: Path) -> None:
    """Wait for a file in a folder and remove it: a test decides how many runs finish."""
    while not (tokens := list(folder.iterdir())):
        time.sleep(0.01)
    tokens[0].unlink()


class Adapter(Baseline):
    _compiled = False

    def warm_up(self, instance: Instance) -> None:
        if "compiles" in self.options["fault"]:
            import numba  # noqa: F401

    def solve(self, instance: Instance, limits: Limits) -> Solution:
        if self.options["fault"] == "waits":  # on every instance
            take_token(Path(os.environ["DCREG_FAULT_TOKENS"]))
        solution = Solution(Status.CONVERGED, np.eye(instance.dim + 1))
        fault = "none"
        if self.options["fault"] == "any":
            fault = FAULTS.get(len(instance.source), fault)
        elif len(instance.source) == UNLUCKY:
            fault = self.options["fault"]
        return getattr(self, f"_{fault}")(solution) or solution

    def _none(self, solution: Solution) -> None:
        """No fault."""

    def _raises(self, solution: Solution) -> None:
        raise ZeroDivisionError("planted")

    def _hangs(self, solution: Solution) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a polite request will not do
        while True:
            time.sleep(0.01)

    def _hangs_with_child(self, solution: Solution) -> None:
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        print(f"child {child.pid}", flush=True)
        self._hangs(solution)

    def _grows(self, solution: Solution) -> None:
        kept = []
        while True:
            kept.append(np.ones(2**22))  # 32 MB, touched

    def _bursts(self, solution: Solution) -> None:
        np.empty(2**37)  # 1 TB at once, more than any machine gives

    def _compiles(self, solution: Solution) -> None:
        """What the warm-up has forgotten, once, and for longer than the limit."""
        if not self._compiled:
            self._compiled = True
            self._always_compiles(solution)
            time.sleep(LONG_S)

    def _always_compiles(self, solution: Solution) -> None:
        import numba

        for _ in range(2):
            numba.njit(lambda: 1)()

    def _exits(self, solution: Solution) -> None:
        os._exit(3)

    def _is_killed(self, solution: Solution) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def _crashes(self, solution: Solution) -> None:
        os.kill(os.getpid(), signal.SIGSEGV)

    def _crashes_once(self, solution: Solution) -> None:
        mark = Path(os.environ["DCREG_FAULT_TOKENS"]) / "crashed"
        if not mark.exists():
            mark.touch()
            self._crashes(solution)

    def _exhausts_once(self, solution: Solution) -> None:
        """Also in any later try of the same process."""
        mark = Path(os.environ["DCREG_FAULT_TOKENS"]) / "exhausted"
        if not mark.exists() or mark.read_text() == str(os.getpid()):
            mark.write_text(str(os.getpid()))
            raise MemoryError

    def _stops_once(self, solution: Solution) -> None:
        mark = Path(os.environ["DCREG_FAULT_TOKENS"]) / "stopped"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGSTOP)

    def _waits_once(self, solution: Solution) -> None:
        """As for a thread that could not start."""
        mark = Path(os.environ["DCREG_FAULT_TOKENS"]) / "waited"
        if not mark.exists():
            mark.touch()
            print(
                "Exception ignored in thread started by:\nMemoryError:", file=sys.stderr, flush=True
            )
            time.sleep(1000)

    def _is_late(self, solution: Solution) -> None:
        """Before it would be killed."""
        time.sleep(LATE_S)

    def _gives_no_pose(self, solution: Solution) -> Solution:
        return Solution(Status.OPTIMAL, None)

    def _crosses_bounds(self, solution: Solution) -> Solution:
        return Solution(
            Status.OPTIMAL, solution.T_target_source, lower_bound=5.0, upper_bound=1.0, gap_tol=0.1
        )

    def _gives_up(self, solution: Solution) -> Solution:
        return Solution(Status.TIME_LIMIT, None)

    def _searches(self, solution: Solution) -> None:
        """With two events of a search, one right after the other."""
        for lower in (1.0, 2.0):
            event = Event("bound", "search", 0.0, 1, 1, 1, lower_bound=lower, upper_bound=4.0)
            Budget().report(event)

    def _gives_nan(self, solution: Solution) -> Solution:
        return Solution(Status.CONVERGED, solution.T_target_source * np.nan)
