"""Ctrl-C before and after a search; during one `dcreg.cli.progress.Progress` treats it."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from types import FrameType

EXIT_INTERRUPTED = 130


def end_at_once() -> None:
    """From now on Ctrl-C ends the process: while packages are loaded an exception surfaces anywhere."""
    signal.signal(signal.SIGINT, _end)


def raise_again() -> None:
    """From now on Ctrl-C raises KeyboardInterrupt, so that a half-written file is removed."""
    with suppress(ValueError):  # handlers can be set in the main thread only
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    os._exit(EXIT_INTERRUPTED)
