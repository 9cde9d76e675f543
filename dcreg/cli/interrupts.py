"""Ctrl-C and SIGTERM where no search runs; during one `dcreg.cli.progress.Progress` treats them."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NOTHING = "interrupted: there is no result, and nothing is written"
_NOT_ALL = "interrupted: the result is printed above, its files are not all written"


class Interrupt(KeyboardInterrupt):
    """A signal that ends the command.

    Parameters
    ----------
    number : int
        Of the signal.
    message : str
        What the user should know.
    """

    def __init__(self, number: int = signal.SIGINT, message: str = _NOTHING) -> None:
        super().__init__(message)
        self.number, self.message = number, message


def end_at_once() -> None:
    """From now on a signal ends the process: while packages are loaded an exception surfaces anywhere."""
    _handle(lambda number, _: leave(Interrupt(number)))


def raise_again() -> None:
    """From now on a signal raises `Interrupt`, so that a half-written file is removed."""
    _handle(_raise)


def leave(interrupt: Interrupt) -> NoReturn:
    """End the process at once, whatever its threads do, with 128 and the number of the signal."""
    # printing may be what was interrupted, or nobody reads
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
