"""Join results of several machines: ``python -m workflows merge A B … --out DIR``.

A source is an archive, the results of an experiment (``results/NAME``), or a folder that contains either.
The merged folder contains one journal of runs per method, and the list of blocks if the runs are
collected evidence. ``python -m workflows run`` makes instances, tables and report from them, and repeats
no run.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from workflows import UserError
from workflows.cli import user_errors
from workflows.integrity import readable, refuse_damaged, sealed
from workflows.journal import Key, as_lines, key_of, lines_of
from workflows.outcomes import STARTED, outcome
from workflows.stages.worker import COUNTERS

if TYPE_CHECKING:
    import pandas as pd

JOURNAL = "merged.journal.jsonl"
ROUNDING = 1e-5  # of bounds, which are compared in six digits
NOT_STARTED = ("unavailable", "not_run")  # statuses of runs that no journal has


class MergeError(UserError):
    """Results cannot be joined; the message names both files, the field, both values and the remedy."""


class Found(NamedTuple):
    """A run as in a journal, and the file that holds it."""

    row: dict[str, Any]
    place: Path


@dataclass(frozen=True)
class Source:
    """The runs of one experiment in one folder."""

    experiment: str
    folder: Path
    methods: Mapping[str, tuple[str, str]]  # name -> baseline and JSON of the options in effect

    def runs(self, method: str) -> Iterator[Found]:
        """Yield the runs of a method; of several with the same key, the last one counts."""
        if (self.folder / "archive.json").is_file():
            yield from self._archived(method)
        else:
            yield from self._journalled(self.folder / "runs" / method)

    def needs(self) -> Path:
        """Return the file with the blocks of collected evidence, whether or not it exists."""
        from workflows.blocks import EVIDENCE, NEEDS

        is_archive = (self.folder / "archive.json").is_file()
        place = Path("experiments", self.experiment) if is_archive else Path(EVIDENCE)
        return self.folder / place / NEEDS

    def _archived(self, method: str) -> Iterator[Found]:
        import pandas as pd

        from workflows import archives, records

        wanted = [("experiment", "==", self.experiment), ("method", "==", method)]
        path = self.folder / archives.RUNS
        runs = pd.read_parquet(path, columns=list(records.RAW), filters=wanted)
        events = pd.read_parquet(
            self.folder / archives.TRACES,
            filters=[wanted[0], ("run_id", "in", set(runs["run_id"]))],
        )
        yield from _started(runs, events, path)

    def _journalled(self, folder: Path) -> Iterator[Found]:
        import pandas as pd

        known = set()
        for path, row in lines_of(folder):
            known.add(key_of(row))
            yield Found(row, path)
        # a run that was taken from an archive is in no journal
        for path in sorted(folder.glob("*.parquet")):
            trace = path.with_suffix(".trace.parquet")
            if path.name.endswith(".trace.parquet") or not trace.is_file():
                continue
            with readable(path):
                runs = pd.read_parquet(path)
            keys = zip(runs["run_id"], runs["instance_digest"], runs["fingerprint"], strict=True)
            if len(rest := runs[[key not in known for key in keys]]):
                with readable(trace):
                    events = pd.read_parquet(trace)
                yield from _started(rest, events, path)


@dataclass
class Merged:
    """What `merge` wrote for an experiment."""

    experiment: str
    runs: int = 0
    duplicates: int = 0  # copies that were dropped, as another source has the run too
    replaced: int = 0  # of these, failed or limited ones in favour of a better copy
    other_work: int = 0  # of these, with another number of boxes or assignments than the kept copy
    machines: set[str] = field(default_factory=set)


def merge(sources: Sequence[Path], out: Path, *, mixed_machines: bool = False) -> list[Merged]:
    """Write the runs of all sources to the folder `out`, a folder per experiment.

    One copy of each run is kept. Copies from the machine with the most runs come first, then those that
    ended by themselves or at a limit on work, then those at another limit, then those of earlier sources.

    Parameters
    ----------
    sources : sequence of Path
    out : Path
        Must not have results of the same experiments.
    mixed_machines : bool
        Whether runs of an experiment may come from several machines. Reports then use the times of the
        machine with the most runs.

    Raises
    ------
    MergeError, ArchiveError, DamagedError
        A source has no results or is damaged, instances or results contradict each other, or machines
        differ without `mixed_machines`. Nothing is written in these cases.
    """
    by_experiment: dict[str, list[Source]] = defaultdict(list)
    for place in sources:
        for source in _sources(place):
            by_experiment[source.experiment].append(source)
    for experiment in by_experiment:
        if (out / experiment).exists():
            raise MergeError(
                f"{out / experiment}: exists; give another folder, and name this one as a source to keep "
                "its runs"
            )
    part = out / ".merge.part"
    shutil.rmtree(part, ignore_errors=True)
    try:
        written = [
            _merge_experiment(experiment, own, part / experiment, mixed_machines=mixed_machines)
            for experiment, own in by_experiment.items()
        ]
        for experiment in by_experiment:
            (part / experiment).rename(out / experiment)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return written


def _sources(place: Path) -> Iterator[Source]:
    """Yield the sources in a folder: one per experiment."""
    from workflows import archives

    if (place / "archive.json").is_file():
        archives.check(place)
        yield from _sources_of_archive(place)
        return
    folders = [each for each in (place, *sorted(place.glob("*"))) if (each / "runs").is_dir()]
    if not folders:
        what = "no folder with runs, and no archive.json" if place.is_dir() else "no such folder"
        raise MergeError(
            f"{place}: {what}; name results/EXPERIMENT, a folder of such results, or the folder of an "
            "archive"
        )
    for folder in folders:
        names = sorted(path.name for path in (folder / "runs").iterdir() if path.is_dir())
        for name in names:
            refuse_damaged(folder / "runs" / name)
        known = _planned_methods(folder)
        yield Source(
            folder.resolve().name, folder, {name: known.get(name, ("", "")) for name in names}
        )


def _sources_of_archive(folder: Path) -> Iterator[Source]:
    import pandas as pd

    from workflows import archives

    columns = ["experiment", "method", "baseline", "options_effective"]
    lines = pd.read_parquet(folder / archives.RUNS, columns=columns).drop_duplicates()
    for experiment, part in lines.groupby("experiment", sort=False):
        methods = _settings(part)
        yield Source(str(experiment), folder, methods)


def _planned_methods(folder: Path) -> dict[str, tuple[str, str]]:
    """Return baseline and effective options of the methods in all plans of an experiment."""
    import pandas as pd

    columns = ["method", "baseline", "options_effective"]
    known: dict[str, tuple[str, str]] = {}
    for path in sorted(folder.glob("**/plan/plan.parquet")):
        refuse_damaged(path.parent)
        with readable(path):
            known |= _settings(pd.read_parquet(path, columns=columns).drop_duplicates())
    return known


def _settings(runs: pd.DataFrame) -> dict[str, tuple[str, str]]:
    return {
        row["method"]: (row["baseline"], row["options_effective"])
        for row in runs.to_dict("records")
    }


def _started(runs: pd.DataFrame, events: pd.DataFrame, place: Path) -> Iterator[Found]:
    """Yield the runs of tables that a journal would have."""
    for row in as_lines(runs[~runs["status"].isin(NOT_STARTED)], events):
        yield Found(row, place)


class _Seen(NamedTuple):
    """A digest of an instance: the run and the file that state it."""

    digest: str
    run_id: str
    place: Path


def _merge_experiment(
    experiment: str, sources: Sequence[Source], out: Path, *, mixed_machines: bool
) -> Merged:
    written = Merged(experiment)
    main = _main_machine(sources) if mixed_machines else ""
    machines: dict[str, Found] = {}
    instances: list[dict[Any, dict[str, _Seen]]] = [{} for _ in sources]
    for method in dict.fromkeys(name for source in sources for name in source.methods):
        joined: dict[Key, Found] = {}
        for source, seen in zip(sources, instances, strict=True):
            own = {key_of(found.row): found for found in source.runs(method)}
            settings = source.methods.get(method, ("", ""))
            _note_instances(method, own.values(), seen, is_shared=_shares_instances(*settings))
            for key, found in own.items():
                machines.setdefault(found.row["machine_id"], found)
                if known := joined.get(key):
                    one, other = known, found
                    found = _one_of(
                        method, one, other, main=main, is_exact=_is_deterministic(settings[0])
                    )
                    dropped = other if found is one else one
                    written.duplicates += 1
                    written.replaced += _rank(found.row["status"]) < _rank(dropped.row["status"])
                    written.other_work += any(
                        found.row.get(name) != dropped.row.get(name) for name in COUNTERS
                    )
                joined[key] = found
        if joined:
            path = out / "runs" / method / JOURNAL
            path.parent.mkdir(parents=True)
            with path.open("w", encoding="utf-8") as journal:
                journal.writelines(f"{sealed(found.row)}\n" for found in joined.values())
        written.runs += len(joined)
    _check_instances(instances)
    if len(machines) > 1 and not mixed_machines:
        raise _two_machines(*list(machines.values())[:2])
    written.machines = set(machines)
    _merge_needs(sources, out)
    return written


def _note_instances(
    method: str, runs: Iterable[Found], seen: dict[Any, dict[str, _Seen]], *, is_shared: bool
) -> None:
    """Add the digest of each instance to `seen`, by everything that may change the instance."""
    for row, place in runs:
        what = [row[name] for name in ("instance_id", "n_source", "n_target", "n_inliers", "seed")]
        digest = row["instance_digest"]
        noted = seen.setdefault((*what, "" if is_shared else method), {})
        noted[digest] = _Seen(digest, row["run_id"], place)


def _shares_instances(baseline: str, options: str) -> bool:
    """Tell whether a method receives the same instances as others, which the oracle does not."""
    from baselines import registry

    if baseline not in registry.names():
        return False
    return registry.oracle_outliers(baseline, json.loads(options)) is None


def _is_deterministic(baseline: str) -> bool:
    from baselines import registry

    return baseline not in registry.names() or registry.read_card(baseline).deterministic


def _check_instances(sources: Sequence[dict[Any, dict[str, _Seen]]]) -> None:
    """Refuse an instance of which two sources have no digest in common."""
    for at, seen in enumerate(sources):
        for what, noted in seen.items():
            for other in sources[:at]:
                if (known := other.get(what)) and not known.keys() & noted.keys():
                    first, second = next(iter(known.values())), next(iter(noted.values()))
                    raise MergeError(
                        f"{first.place} and {second.place}: instance {what[0]} has instance_digest "
                        f"{first.digest!r} (run {first.run_id}) and {second.digest!r} (run "
                        f"{second.run_id}): the data, the code or the rule of the digest differ; leave "
                        "one source out, or repeat its runs with the data and code of the other"
                    )


def _main_machine(sources: Sequence[Source]) -> str:
    """Return the ``machine_id`` with the most attempted runs, as in reports; copies count once."""
    machines = {
        (method, key_of(found.row), found.row["machine_id"])
        for source in sources
        for method in source.methods
        for found in source.runs(method)
        if outcome(found.row["status"]) in STARTED
    }
    counts = Counter(machine for _, _, machine in sorted(machines))
    return str(counts.most_common(1)[0][0]) if counts else ""


def _one_of(method: str, first: Found, second: Found, *, main: str, is_exact: bool) -> Found:
    """Return the run to keep of two with equal version, options, instance and limits.

    A run on the `main` machine is kept even if that of another machine ended better. Otherwise the slow
    runs would be missing in the times, which are those of the main machine.
    """
    ranks = [_rank(found.row["status"]) for found in (first, second)]
    if is_exact and ranks == [0, 0]:
        one, other = (_result(found.row) for found in (first, second))
        same = first.row["machine_id"] == second.row["machine_id"]
        if found := _contradiction(one, other, same_machine=same):
            name, value, against = found
            raise MergeError(
                f"{first.place} and {second.place}: run {first.row['run_id']} of {method} has {name} "
                f"{value!r} and {against!r}, although version, options, instance and limits are equal; "
                "leave the wrong source out (`python -m workflows replay` repeats a run), or give the "
                "method another version"
            )
    on_main = [found.row["machine_id"] == main for found in (first, second)]
    if on_main[0] != on_main[1]:
        return first if on_main[0] else second
    return second if ranks[1] < ranks[0] else first


def _contradiction(
    one: Mapping[str, Any], other: Mapping[str, Any], *, same_machine: bool
) -> tuple[str, Any, Any] | None:
    """Return name and values of what contradicts in two results; None if nothing does.

    After the same work on one machine all values must be equal; other machines round differently. Two
    searches that ended by themselves may differ in their work, because elapsed time ends some of their
    stages. In both cases, their bounds must not cross.
    """
    differing = [name for name, value in one.items() if value != other.get(name)]
    if same_machine and not any(name in COUNTERS for name in differing):
        return (name := differing[0], one[name], other.get(name)) if differing else None
    for lower, upper in (
        (one["lower_bound"], other["upper_bound"]),
        (other["lower_bound"], one["upper_bound"]),
    ):
        if None not in (lower, upper) and float(lower) > float(upper) * (1 + ROUNDING):
            return "lower_bound against upper_bound", lower, upper
    return None


def _rank(status: str) -> int:
    """Return 0 for a run that ended by itself or at a limit of work, 1 at another limit, else 2."""
    from workflows.outcomes import ENDED, TIMED, outcome

    if status in TIMED:
        return 1
    return 0 if outcome(status) in ENDED else 2


def _result(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that a repetition must reproduce, by column."""
    from workflows.versions import comparable

    pose = row["T_target_source"]
    result = comparable({**row, "T_target_source": json.loads(pose) if pose else None})
    return {
        ("T_target_source" if name == "pose" else name): value for name, value in result.items()
    }


def _two_machines(first: Found, second: Found) -> MergeError:
    return MergeError(
        f"{first.place} and {second.place}: machine_id is {first.row['machine_id']!r} and "
        f"{second.row['machine_id']!r}: times of several machines are not comparable; pass "
        "--mixed-machines to merge them anyway, and use the times of one machine only"
    )


def _merge_needs(sources: Sequence[Source], out: Path) -> None:
    """Join the blocks of collected evidence: of each test, method and level, the largest number."""
    from workflows.blocks import EVIDENCE, NEEDS, Needs

    needs = Needs({})
    for path in (source.needs() for source in sources):
        if path.is_file():
            needs = needs.joined(Needs.read(path))
    if needs.trials:
        needs.write(out / EVIDENCE / NEEDS)


@user_errors
def command(
    sources: Annotated[
        list[Path],
        typer.Argument(help="results/EXPERIMENT, folders of such results, or folders of archives."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the merged results.")],
    mixed_machines: Annotated[
        bool,
        typer.Option("--mixed-machines", help="Allow runs of several machines in an experiment."),
    ] = False,
) -> None:
    """Join results of several machines. If OUT is DIR/results, `run --directory DIR` continues from them.

    Different instances with the same name, contradictory results, and (without --mixed-machines) several
    machines are refused. With --mixed-machines, reports use only the times of the machine with the most
    runs.
    """
    for found in merge(sources, out, mixed_machines=mixed_machines):
        print(
            f"merged    {out / found.experiment}: {found.runs} runs; dropped {found.duplicates} "
            f"duplicates ({found.replaced} failed or limited, {found.other_work} with other counts of "
            f"boxes or assignments); machine_id: "
            f"{', '.join(sorted(found.machines))}"
        )
