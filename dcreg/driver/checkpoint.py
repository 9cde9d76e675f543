"""Checkpoint files: the state of a search, from which the same search continues.

A file holds NumPy arrays and JSON, never code. It is replaced as a whole, so a process that is killed
leaves the previous state.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.driver.checks import norms_only
from dcreg.driver.options import Limits, SolveOptions
from dcreg.families.mode import Mode
from dcreg.families.protocol import Strongest
from dcreg.files import as_json, whole_file
from dcreg.problem import InputError, Problem
from dcreg.search import Bound, Boxes, Budget, Confined, Event, Start, Tolerance
from dcreg.search.boxes import OpenNodes
from dcreg.search.branch_and_bound import Search
from dcreg.search.space_search import Course

_LOGGER = logging.getLogger("dcreg")
INTERVAL_S = 120.0  # between two checkpoints
WRITING_SHARE = 0.02  # maximum share of the time for writing
# Attributes of a search that are saved as they are.
_SEARCH = (
    "theta", "upper_bound", "pruned_bound", "floor", "worth_refining", "n_nodes", "n_refining", "began",
)  # fmt: skip
_ARRAYS = ("source", "target", "candidates")


def open_checkpoint(
    problem: Problem, mode: Mode, limits: Limits, options: SolveOptions
) -> CheckpointFile:
    """Return the file in which a search saves its state, ``options.checkpoint``.

    Raises
    ------
    InputError
        If the search cannot be continued, or the file is not one of this search.
    """
    assert options.checkpoint is not None
    if mode.rotation is not None:
        raise InputError(
            "checkpoint: only a search over poses can be continued; omit checkpoint, or change this: "
            + norms_only(mode, problem, bound=options.bound)
        )
    if problem.pose_range is not None and problem.pose_range.has_limits:
        raise InputError(
            "checkpoint: a search within limits of angle or translation cannot be continued; omit "
            "checkpoint, or max_angle and max_translation"
        )
    path = Path(options.checkpoint)
    if not path.absolute().parent.is_dir():
        raise InputError(f"checkpoint: {path}: no folder {str(path.parent)!r}; create it first")
    return CheckpointFile(path, _identity(problem, mode, limits, options))


def _identity(
    problem: Problem, mode: Mode, limits: Limits, options: SolveOptions
) -> dict[str, Any]:
    """Return what a search depends on: the version, the problem and the options that change it."""
    given: dict[str, Any] = {name: _digest(getattr(problem, name)) for name in _ARRAYS}
    weights = problem.weights
    given["attributes"] = weights and _digest(weights.attributes)
    given["weights"] = weights and [_digest(weights.factors), _digest(weights.extra)]
    names = "n_inliers", "model", "scale_range", "pose_range"
    given |= {name: getattr(problem, name) for name in names}
    given |= {name: getattr(limits, name) for name in ("rel_gap", "abs_gap", "tol", "max_rms")}
    given |= {name: getattr(options, name) for name in ("start_box", "certificate", "init")}
    given |= {"mode": mode.name, "bound": options.bound or "default"}
    # as JSON and back, so that it compares equal to what is read from a file
    return {"version": __version__, **json.loads(as_json(given))}


def _digest(array: np.ndarray | None) -> str | None:
    if array is None:
        return None
    return hashlib.sha256(repr(array.shape).encode() + array.tobytes()).hexdigest()


class CheckpointFile:
    """A file in which a search saves its state; see `dcreg.search.budget.Checkpoint`.

    Parameters
    ----------
    path : Path
        If it exists, the search continues from its state.
    identity : dict
        What the search depends on.

    Raises
    ------
    InputError
        If the file cannot be read, or is that of another search.
    """

    def __init__(self, path: Path, identity: dict[str, Any]) -> None:
        self._path, self._identity = path, identity
        self._state = _read(path, identity) if os.path.lexists(path) else None
        self._due = time.monotonic() + INTERVAL_S

    @property
    def is_resumed(self) -> bool:
        """Whether the file holds the state of an earlier search."""
        return self._state is not None

    def attach(self, budget: Budget) -> None:
        """Let all searches within `budget` use the file, and count the time of the earlier search."""
        budget.checkpoint, state = self, self._state
        if state is None:
            return
        budget.add_earlier(state["elapsed_s"], _events(state["history"]))
        nodes = (state["part"] or state["search"])["n_nodes"]
        _LOGGER.info(
            f"continuing the search of {self._path}: {text.count(nodes, 'box', 'boxes')} in "
            f"{state['elapsed_s']:.0f} s of earlier runs"
        )

    def save(self, course: Course, at_once: bool) -> None:
        """Write the state of the search if it is time for that, or `at_once`."""
        began = time.monotonic()
        if began < self._due and not at_once:
            return
        try:
            _write(self._path, {"identity": self._identity, **_state_of(course)})
        except OSError as error:  # not worth the loss of a search
            reason = error.strerror or error
            _LOGGER.warning(
                f"checkpoint {self._path}: cannot be written ({reason}); the search continues"
            )
        ended = time.monotonic()
        self._due = ended + max(INTERVAL_S, (ended - began) / WRITING_SHARE)

    def restore(self, course: Course) -> None:
        """Continue `course`, which has not begun, from the state of the file."""
        state, self._state = self._state, None  # the arrays are copied, and may be large
        assert state is not None
        space, search = course.space, course.search
        space.ends = [(np.array(theta), value) for theta, value in state["ends"]]
        space.is_confirmed = state["is_confirmed"]
        course.n_shares, course.abandoned_s = state["n_shares"], state["abandoned_s"]
        course.proven, course.too_large = tuple(state["proven"]), state["too_large"]
        course.confined = [_confined(each) for each in state["confined"]]
        for bound, saved in zip(_parts(search.bound), state["bounds"], strict=True):
            bound.n_assignments = saved["n_assignments"]
            if saved["stored"] is not None:
                bound.stored.restore(saved["stored"])
        _restore(search, state["search"], course)
        if state["part"] is not None:
            tolerance = Tolerance(**state["part"]["tolerance"])
            course.part = search.confined_to(course.confined[-1], tolerance)
            _restore(course.part, state["part"], course)


def _state_of(course: Course) -> dict[str, Any]:
    """Return what `CheckpointFile.restore` needs."""
    search, part, space = course.search, course.part, course.space
    budget = search.budget
    # an interrupted kernel leaves values incomplete
    is_whole = not (part or search).is_over
    bounds = [
        {
            "n_assignments": bound.n_assignments,
            "stored": bound.stored.state() if is_whole and bound.stored is not None else None,
        }
        for bound in _parts(search.bound)
    ]
    return {
        "elapsed_s": budget.elapsed(), "history": budget.history, "bounds": bounds,
        "ends": [(theta.tolist(), value) for theta, value in space.ends],
        "is_confirmed": space.is_confirmed, "n_shares": course.n_shares, "too_large": course.too_large,
        "abandoned_s": course.abandoned_s, "proven": course.proven, "confined": course.confined,
        "search": _search_state(search), "part": None if part is None else _search_state(part),
    }  # fmt: skip


def _parts(bound: Bound) -> list[Any]:
    """Return the bounds of which `bound` consists."""
    return list(bound.parts) if isinstance(bound, Strongest) else [bound]


def _search_state(search: Search) -> dict[str, Any]:
    leaves = search.leaves.boxes if search.leaves else None
    return {
        **{name: getattr(search, name) for name in (*_SEARCH, "tolerance", "start")},
        "boxes": search.boxes, "nodes": search.nodes.boxes(), "leaves": leaves,
        "events": search.events, "is_narrowed": search.region is not None,
    }  # fmt: skip


def _restore(search: Search, state: dict[str, Any], course: Course) -> None:
    """Give a new search the saved state. It has its whole patience again."""
    for name in _SEARCH:
        setattr(search, name, state[name])
    search.start, search.boxes = Start(*state["start"]), Boxes(**state["boxes"])
    search.nodes = OpenNodes(search.theta.size)
    search.nodes.push(Boxes(**state["nodes"]))
    search.events = _events(state["events"])
    search.region = course.confined[-1] if state["is_narrowed"] else None
    if search.leaves is not None and state["leaves"]:
        search.leaves.add(Boxes(**state["leaves"]))
    search.n_nodes_before, search.patience_began = search.n_nodes, search.budget.elapsed()


def _events(saved: list[dict[str, Any]]) -> list[Event]:
    """Return saved events without the end of the search, which continues."""
    return [Event(**each) for each in saved if each["kind"] != "end"]


def _confined(saved: dict[str, Any]) -> Confined:
    return Confined(Boxes(**saved.pop("boxes")), **saved)


# --- the file -----------------------------------------------------------------------------------------


def _write(path: Path, state: dict[str, Any]) -> None:
    """Write nested dictionaries and lists of numbers, texts and arrays, completely or not at all."""
    arrays: dict[str, Any] = {}

    def plain(value: Any) -> Any:
        match value:
            case np.ndarray():
                arrays[name := f"array{len(arrays)}"] = value
                return {"array": name}
            case dict():
                return {key: plain(each) for key, each in value.items()}
            case list() | tuple():
                return [plain(each) for each in value]
            case Boxes():
                return plain(vars(value))
            case np.generic():
                return value.item()
            case _ if is_dataclass(value):
                return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
            case _:
                return value

    content = np.frombuffer(json.dumps(plain(state)).encode(), np.uint8)
    # an open file keeps NumPy from appending ".npz"
    with whole_file(path) as part, part.open("wb") as stream:
        np.savez(stream, content=content, **arrays)
        stream.flush()
        os.fsync(stream.fileno())  # the old file is complete until the new one is


def _read(path: Path, identity: dict[str, Any]) -> dict[str, Any]:
    """Return the state in a file.

    Raises
    ------
    InputError
        If the file cannot be read, or is that of another search.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            loaded = dict(arrays)
        content = loaded["content"].tobytes().decode()
        state: dict[str, Any] = json.loads(
            content,
            object_hook=lambda each: loaded[each["array"]] if [*each] == ["array"] else each,
        )
        saved = state.pop("identity")
    except Exception as error:  # whatever NumPy, zipfile and json raise for other or damaged files
        raise InputError(
            f"checkpoint: {path} is not a checkpoint, or is damaged ({type(error).__name__}); name "
            "another file, or remove a damaged checkpoint to start again"
        ) from None
    for name in identity:
        if (old := saved.get(name)) == (new := identity[name]):
            continue
        if name == "version":
            problem = f"was written by dcreg {old}, but this is dcreg {new}; use dcreg {old}"
        elif name in (*_ARRAYS, "attributes", "weights"):
            problem = f"belongs to another problem ({name} differs); give the same files"
        elif name == "init":
            problem = "belongs to a search from another pose; give the same initial or judged pose"
        else:
            problem = f"belongs to a search with {name} {old}, not {new}; give the same options"
        raise InputError(
            f"checkpoint: {path} {problem}, name another checkpoint file, or delete this one"
        )
    return state
