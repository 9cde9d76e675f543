"""``python -m tests.bad_input [AREA]``: try every case; exit code 1 where one is not refused well.

Every case runs in a process of its own, forked with all loaded, in a new folder, under limits of time
and memory.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from typer.main import get_command

from dcreg.cli.program import app
from tests.bad_input import AREAS
from tests.bad_input.case import CLOUDS, Case

SECONDS = 120  # of a case that hangs, however busy the machine is
EXTRA_MEMORY = 3 * 2**30  # bytes of address space beyond what is loaded
LOADED_LATE = (
    "pydantic", "scipy.io", "typer.rich_utils", "workflows.config",
    "dcreg.cli.progress", "dcreg.driver.solve", "dcreg.driver.sweep",
)  # fmt: skip
COMMAND = get_command(app)
COUNTS = ("tracebacks", "hangs", "memory deaths", "accepted", "unclear messages")


def main(areas: list[str]) -> int:
    cases = [case for area in areas or AREAS for case in AREAS[area]]
    names = Counter((case.area, case.name) for case in cases)
    twice = [name for name, count in names.items() if count > 1]
    assert not twice, f"the same name twice: {twice}"
    for name in LOADED_LATE:
        importlib.import_module(name)  # here, not in every process
    gc.freeze()  # processes share the objects; those that collect garbage would copy them
    found: Counter[str] = Counter()
    for case in cases:
        fault, message = judge(case)
        if fault:
            found[fault] += 1
            print(f"{case.area}/{case.name}: {fault}\n    {message}\n    expected: {case.words}")
    kinds = ", ".join(f"{count} {area}" for area, count in Counter(c.area for c in cases).items())
    print(f"{len(cases)} kinds of bad input ({kinds})")
    print(", ".join(f"{found[name]} {name}" for name in COUNTS))
    return int(found.total() > 0)


def judge(case: Case) -> tuple[str, str]:
    """What is wrong with how a case is treated (empty: nothing), and its message."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, cloud in CLOUDS.items():
            np.savetxt(folder / file, cloud)
        for file, content in case.files.items():
            (folder / file).mkdir() if content is None else (folder / file).write_bytes(content)
        log = folder / ".log"
        code = _forked(case, folder, log)
        text = log.read_text(errors="replace") if log.exists() else ""
    message = " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())
    if code is None:
        return "hangs", message
    if "MemoryError" in message or code == -signal.SIGKILL:
        return "memory deaths", message[-300:]
    if "Traceback" in message or "RuntimeWarning" in message or code < 0:
        return "tracebacks", message[-600:]
    if code != case.code:
        return "accepted", f"exit code {code}: {message[:300]}"
    if any(word not in message for word in case.words):
        return "unclear messages", message[:600]
    return "", message


def _forked(case: Case, folder: Path, log: Path) -> int | None:
    """Exit code of the case in a process of its own; None where it took too long."""
    process = os.fork()
    if process == 0:
        try:
            _inside(case, folder, log)
        finally:
            os._exit(99)
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def _inside(case: Case, folder: Path, log: Path) -> None:
    """Run the case with its output in `log`; ends the process."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + EXTRA_MEMORY,) * 2)
    stream = os.open(log, os.O_WRONLY | os.O_CREAT)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    os.chdir(folder)
    os.environ["COLUMNS"] = "1000"  # no line is broken within a word
    code = 1
    with open(1, "w", closefd=False) as out, contextlib.redirect_stdout(out):
        with contextlib.redirect_stderr(out):
            try:
                code = _code_of(case)
            except BaseException:
                traceback.print_exc()
        out.flush()
    os._exit(code)


def _code_of(case: Case) -> int:
    if callable(case.run):
        try:
            case.run()
        except ValueError as error:  # all errors of bad input are of this kind
            if type(error).__name__ not in ("InputError", "ConfigError"):
                raise
            print(error)
            return 2
        return 0
    try:
        COMMAND(list(case.run), prog_name="dcreg")
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
