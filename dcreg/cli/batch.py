"""The command ``batch``: a table of pairs, the processes that solve them, and the table of results."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import typer

import dcreg
from dcreg.cli import output
from dcreg.cli.files import BatchFiles
from dcreg.cli.folder import in_order, pairs_of_folder
from dcreg.cli.interrupts import SIGNALS
from dcreg.cli.numbers import parse_count_or_auto
from dcreg.cli.options import Goal, Poses, Search
from dcreg.cli.pair import Row, Task, answer_of, columns, edge_of, failed, is_matched
from dcreg.cli.workers import solve_all
from dcreg.files import write_text
from dcreg.names import AUTO, MODEL_DIM

_FAILED = failed("")["status"]
_FINISHED = tuple(
    status.value for status in (dcreg.Status.OPTIMAL, dcreg.Status.CONVERGED, dcreg.Status.REFUTED)
)


@dataclass(frozen=True)
class Batch:
    """The pairs of a table or a folder and how to solve them.

    Parameters
    ----------
    pairs : Path
        Table with the columns ``source``, ``target`` and, if wanted, ``n_inliers``; files are relative to
        its folder. Or a folder, see `dcreg.cli.folder`.
    search : Search
    poses : Poses
    goal : Goal
        Its number of pairs applies where the table gives none.
    drop_invalid : bool
    """

    pairs: Path
    search: Search
    poses: Poses
    goal: Goal
    drop_invalid: bool

    def run(self, files: BatchFiles, jobs: int, quiet: bool) -> int:
        """Solve the pairs that the table of results does not hold yet; return the exit code.

        Parameters
        ----------
        files : BatchFiles
            The table is written whole after each pair, the pose graph at the end.
        jobs : int
            Number of processes.
        quiet : bool
            Show no progress.
        """
        out, graph = files.out_path, files.graph_path
        self._check(graph, jobs)
        names = self._pairs_of_folder(out) if self.pairs.is_dir() else self._names()
        self._check_numbers(names)
        tasks = self._tasks(names, 1 if jobs > 1 else None)
        inputs = [str(self.pairs), self.search.candidates_path, self.poses.init]
        files.check(*inputs, *(file for task in tasks for file in (task.source, task.target)))
        table = _Table(out, columns(self.search.model), self._described(names))
        content = cache(_content)  # a cloud may be in several pairs
        digests = [self._digest(task, content) for task in tasks]
        todo = [task for task in tasks if not table.take(task.place, digests[task.place])]
        if not quiet and len(todo) < len(tasks):
            typer.echo(f"{len(tasks) - len(todo)} of {len(tasks)} pairs are in {out}", err=True)
        with _signals() as is_stopped:
            if not table.write():
                return output.EXIT_OUTPUT
            for task, row in solve_all(todo, min(jobs, len(todo)), is_stopped, quiet=quiet):
                table.add(task.place, {**row, "inputs": digests[task.place]})
                if not table.write():
                    return output.EXIT_OUTPUT
                _report(table, task.place, quiet)
            return _finish(table, graph, self.goal.max_rms)

    def _check(self, graph: Path | None, jobs: int) -> None:
        """Refuse settings that would fail for every pair."""
        model = self.search.model
        if model not in MODEL_DIM:
            raise dcreg.InputError(f"--model: '{model}' is unknown; known: {', '.join(MODEL_DIM)}")
        self.poses.settings()
        if jobs < 1:
            raise dcreg.InputError(f"--jobs: {jobs} processes; give a positive number")
        if graph is not None and model != "rigid3d" and self.search.scale_range != (1.0, 1.0):
            raise dcreg.InputError(
                f"--graph {graph}: g2o holds rigid poses only; fix the scale with --scale-range 1 1"
            )

    def _check_numbers(self, names: list[Row]) -> None:
        """Refuse a maximum residual that makes no sense, or pairs without a number for it."""
        if self.goal.max_rms is None:
            return
        if not 0.0 < self.goal.max_rms < math.inf:
            raise dcreg.InputError(f"--max-rms: {self.goal.max_rms} is no positive finite number")
        for row in names:
            if row["n_inliers"] == AUTO:
                raise dcreg.InputError(
                    f"--n-inliers: missing for {row['source']} {row['target']}, but --max-rms needs it; "
                    "give a number for all pairs, or for each pair in the table of pairs"
                )

    def _pairs_of_folder(self, out: Path) -> list[Row]:
        """Return the pairs of a folder without a table."""
        parse_count_or_auto(self.goal.n_inliers)
        others = out, self.search.candidates_path, self.poses.init
        pairs = pairs_of_folder(self.pairs, others)
        return [{**pair, "n_inliers": self.goal.n_inliers} for pair in pairs]

    def _names(self) -> list[Row]:
        """Read the table of pairs."""
        try:
            text = self.pairs.read_text("utf-8-sig")
            reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
            if missing := {"source", "target"}.difference(reader.fieldnames or ()):
                raise dcreg.InputError(
                    f"{self.pairs}: no column '{min(missing)}'; let the first line name the columns "
                    "'source', 'target' and, if wanted, 'n_inliers'"
                )
            rows = [self._checked(row, reader.line_num) for row in reader]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            reason = getattr(error, "strerror", None) or error
            raise dcreg.InputError(
                f"{self.pairs}: cannot be read ({reason}); give a table of pairs in UTF-8, or a folder"
            ) from None
        if not rows:
            raise dcreg.InputError(f"{self.pairs}: contains no pairs; give one per line")
        return rows

    def _checked(self, row: Mapping[str, str | None], line: int) -> Row:
        """Return source, target and number of pairs of a line."""
        found = {name: (row.get(name) or "").strip() for name in ("source", "target", "n_inliers")}
        found["n_inliers"] = found["n_inliers"] or self.goal.n_inliers
        for name, value in found.items():
            if not value:
                raise dcreg.InputError(f"{self.pairs}: line {line} has no {name}; add it")
        try:
            parse_count_or_auto(found["n_inliers"])
        except dcreg.InputError as error:
            raise dcreg.InputError(f"{self.pairs}: line {line}: {error}") from None
        return found

    def _described(self, names: list[Row]) -> list[Row]:
        """Return the first columns of each row; files are numbered in the order of table or folder."""
        ends = ("source", "target")
        files = list(dict.fromkeys(Path(row[end]) for row in names for end in ends))
        if self.pairs.is_dir():
            files.sort(key=lambda file: in_order(file.name))
        numbers = {file: str(number) for number, file in enumerate(files)}
        return [
            {end: row[end] for end in ends} | {f"{end}_id": numbers[Path(row[end])] for end in ends}
            for row in names
        ]

    def _tasks(self, names: list[Row], threads: int | None) -> list[Task]:
        """Return the pairs; `threads` is the default of each search."""
        folder = self.pairs if self.pairs.is_dir() else self.pairs.parent
        search = replace(self.search, threads=self.search.threads or threads)
        return [
            Task(
                place,
                str(folder / row["source"]),
                str(folder / row["target"]),
                row["n_inliers"],
                self.goal.max_rms,
                search,
                self.poses,
                self.drop_invalid,
            )
            for place, row in enumerate(names)
        ]

    def _digest(self, task: Task, content: Callable[[str], str]) -> str:
        """Return a digest of what the result of a pair depends on: files, options and version."""
        options = {
            name: content(value) if value and (name == "init" or name.endswith("_path")) else value
            for name, value in {**vars(self.search), **vars(self.poses)}.items()
        }
        keys = [file.rpartition(":")[2] for file in (task.source, task.target) if ":" in file]
        files = [content(task.source), content(task.target), keys]
        goal = task.n_inliers, task.max_rms
        used = [files, *goal, options, self.drop_invalid, dcreg.__version__]
        text = json.dumps(used, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _content(path: str) -> str:
    """Return a digest of a file, which may be given as FILE:KEY."""
    for name in (path, path.rpartition(":")[0]):
        with suppress(OSError), Path(name).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    return "missing"


class _Table:
    """The table of results: a row for each pair that is solved, in the order of the pairs.

    Parameters
    ----------
    path : Path
        If it exists, it holds the results of an earlier call.
    names : list of str
        Columns.
    described : list of Row
        Files and numbers of the clouds of each pair.
    """

    def __init__(self, path: Path, names: list[str], described: list[Row]) -> None:
        self.path, self.names, self.described = path, names, described
        self.rows: dict[int, Row] = {}
        self._old = {row["inputs"]: row for row in self._read() if row["status"] != _FAILED}

    def _read(self) -> list[Row]:
        if not self.path.exists():
            return []
        with self.path.open(newline="", encoding="utf-8", errors="replace") as stream:
            reader = csv.DictReader(stream)
            if reader.fieldnames != self.names:
                raise dcreg.InputError(
                    f"--out {self.path}: exists and is not a table of `dcreg batch` for this model; "
                    "name another file"
                )
            return [row for row in reader if None not in row and None not in row.values()]

    def take(self, place: int, digest: str) -> bool:
        """Take the row of an earlier call with the same inputs and options, if there is one."""
        if digest in self._old:
            self.add(place, self._old[digest])
        return digest in self._old

    def add(self, place: int, row: Row) -> None:
        """Add the result of a pair."""
        self.rows[place] = {**dict.fromkeys(self.names, ""), **row, **self.described[place]}

    def write(self) -> bool:
        """Write the table completely or not at all; print why if it cannot be written."""
        stream = io.StringIO(newline="")
        writer = csv.DictWriter(stream, self.names)
        writer.writeheader()
        writer.writerows(self.rows[place] for place in sorted(self.rows))
        try:
            write_text(self.path, stream.getvalue())
        except OSError as error:
            output.print_error(
                f"cannot write {self.path}: {error.strerror or error}; free some space, then run the "
                "command again: it continues with the pairs that are left"
            )
            return False
        return True


@contextmanager
def _signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether a signal has arrived; files are still written then."""
    arrived: list[int] = []
    before = {}
    with suppress(ValueError):  # handlers can be set in the main thread only
        for number in SIGNALS:
            before[number] = signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield lambda: bool(arrived)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _report(table: _Table, place: int, quiet: bool) -> None:
    """Print a line about a pair that has just been solved."""
    row = table.rows[place]
    pair = f"{row['source']} {row['target']}"
    if row["status"] == _FAILED:
        output.print_error(f"{pair}: {row['error']}")
    elif not quiet:
        done = f"[{len(table.rows)}/{len(table.described)}]"
        rmse = float(row["rmse_matched"])
        typer.echo(f"{done} {pair}: {row['status']}, RMSE {rmse:.4g}, {row['time_s']} s", err=True)


def _finish(table: _Table, graph: Path | None, max_rms: float | None) -> int:
    """Print the number of pairs by status and write the pose graph; return the exit code."""
    rows = [table.rows[place] for place in sorted(table.rows)]
    counts = Counter(answer_of(row, max_rms) for row in rows)
    if left := len(table.described) - len(rows):
        counts["not solved"] = left
    shares = ", ".join(f"{count} {status}" for status, count in counts.items())
    typer.echo(f"{len(table.described)} pairs: {shares}")
    if left:
        typer.echo("stopped; run the same command again to solve the pairs that are left", err=True)
    if graph is not None:
        try:
            _write_graph(graph, [row for row in rows if is_matched(row, max_rms)])
        except OSError as error:
            output.print_error(f"cannot write {graph}: {error.strerror or error}")
            return output.EXIT_OUTPUT
    if counts[_FAILED]:
        return output.EXIT_INPUT
    return output.EXIT_OK if set(counts) <= set(_FINISHED) else output.EXIT_LIMIT


def _write_graph(path: Path, rows: list[Row]) -> None:
    """Write the poses as a pose graph; name the pairs whose information is not known."""
    edges = [(row, edge) for row in rows if (edge := edge_of(row)) is not None]
    without = dcreg.write_pose_graph(path, [edge for _, edge in edges])
    for row, edge in edges:
        if any(edge is each for each in without):
            output.print_warning(
                f"{row['source']} {row['target']}: the covariance is missing or singular; the "
                "information matrix of its edge is the identity"
            )
