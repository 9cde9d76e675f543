"""The modes: ways from a problem to a pose, and what each of them accepts."""

from dcreg.modes.table import (
    CHOSEN,
    MODES,
    Mode,
    choose_mode,
    find_mode,
)
from dcreg.modes.task import Answer, Task
from dcreg.names import AUTO, mode_names

__all__ = [
    "AUTO",
    "CHOSEN",
    "MODES",
    "Answer",
    "Mode",
    "Task",
    "choose_mode",
    "find_mode",
    "mode_names",
]
