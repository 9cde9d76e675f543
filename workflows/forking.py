"""Run the stages of a workflow in processes that share their imports.

The first stage starts a server process that has imported what most stages need; it forks for every
stage. A stage has its own process, but does not import pandas and SciPy again. Stages that need the
plan receive it, so they do not read the config.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.forkserver
import threading
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workflows.stages.plan import Plan

PRELOADED = ["workflows.preload"]  # by the server
_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(PRELOADED)
# `start` and `join` read the exit codes of all stages, and an exit code can be read only once.
_lock = threading.Lock()


class StageError(RuntimeError):
    """A stage has failed; it has printed why."""


def forget_server() -> None:
    """Let a forked process start its own server: it cannot use that of its parent."""
    forkserver: Any = multiprocessing.forkserver
    forkserver._forkserver.__init__()
    _context.set_forkserver_preload(PRELOADED)


def run_stage(program: str, *arguments: str, plan: Plan | None = None) -> None:
    """Run ``python -m PROGRAM ARGUMENTS`` in a forked process and wait for its end.

    `plan` must be the plan of these arguments, or the part of it that the stage needs.

    Raises
    ------
    StageError
    """
    stage = _context.Process(target=_main, args=(program, arguments, plan))
    with _lock:
        stage.start()
    wait([stage.sentinel])
    with _lock:
        stage.join()
    if stage.exitcode:
        raise StageError(f"`{program} {' '.join(arguments)}` ended with exit code {stage.exitcode}")


def _main(program: str, arguments: tuple[str, ...], plan: Plan | None) -> None:
    from importlib import import_module

    if plan is not None:
        from workflows.stages import commands

        commands.known = plan
    import_module(f"{program}.__main__").app(arguments)
