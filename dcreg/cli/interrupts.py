"""Ctrl-C and SIGTERM outside of a search; `dcreg.cli.progress.Progress` handles them during a search."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NOTHING = "interrupted: there is no result, and nothing was written"
_NOT_ALL = "interrupted: the result is printed above, but not all output files were written"


class Interrupt(KeyboardInterrupt):
    """A signal that ends the command.

    Parameters
    ----------
    number : int
        Number of the signal.
    message : str
        Text for the user.
    """

    def __init__(self, number: int = signal.SIGINT, message: str = _NOTHING) -> None:
        super().__init__(message)
        self.number, self.message = number, message


def end_at_once() -> None:
    """Let signals end the process: while packages are loaded, an exception could surface anywhere."""
    _handle(lambda number, _: leave(Interrupt(number)))


def raise_again() -> None:
    """Let signals raise `Interrupt`, so that a partial file is removed."""
    _handle(_raise)


def leave(interrupt: Interrupt) -> NoReturn:
    """End the process and its threads at once with exit code 128 plus the number of the signal."""
    # the signal may have interrupted a print, or the reader may be gone
    with suppress(RuntimeError, OSError):
        sys.stdout.flush()
    os.write(2, f"{interrupt.message}\n".encode())
    os._exit(128 + interrupt.number)


def _raise(number: int, frame: FrameType | None) -> None:
    raise Interrupt(number, _NOT_ALL)


def _handle(handler: signal._HANDLER) -> None:
    with suppress(ValueError):  # handlers can be set in the main thread only
        for number in SIGNALS:
            signal.signal(number, handler)
