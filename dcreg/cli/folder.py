"""The pairs of a folder of clouds that has no table of pairs."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from pathlib import Path

import dcreg
from dcreg.names import READ_SUFFIXES

TABLE = "pairs.csv"  # the table of a folder
ENDS = "_source", "_target"  # of the names of the files of a pair
RESULTS = b"source,target,source_id,target_id,status,"  # the beginning of a table of results


def pairs_of_folder(folder: Path, others: Iterable[Path | str | None]) -> list[dict[str, str]]:
    """Return the pairs NAME_source and NAME_target or, without any, each file with the one before it.

    In the second case, each pose maps a file to the one before it in the order of the names.

    Parameters
    ----------
    folder : Path
    others : iterable of Path or str, optional
        The files of the options. They may lie in the folder, and are no clouds.

    Returns
    -------
    list of dict
        The names of ``source`` and ``target``.

    Raises
    ------
    InputError
    """
    no_clouds = {Path(other).resolve() for other in others if other is not None}
    clouds = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in READ_SUFFIXES
        and not path.name.startswith(".")
        and path.is_file()
        and path.resolve() not in no_clouds
        and not _is_results(path)
    ]
    clouds.sort(key=lambda path: (in_order(path.name), path.name))
    sources, targets = (_by_name(folder, clouds, end) for end in ENDS)
    for found, others, end in ((sources, targets, ENDS[1]), (targets, sources, ENDS[0])):
        for name in sorted(found.keys() - others.keys()):
            raise _ambiguous(folder, f"{found[name]} has no counterpart {name}{end}; add it")
    if sources:
        return [{"source": file, "target": targets[name]} for name, file in sources.items()]
    if len(clouds) < 2:
        raise dcreg.InputError(
            f"{folder}: contains {len(clouds)} point files, but a pair needs two; give another folder "
            "or a table of pairs"
        )
    names = itertools.pairwise(path.name for path in clouds)
    return [{"source": name, "target": before} for before, name in names]


def _by_name(folder: Path, clouds: list[Path], end: str) -> dict[str, str]:
    """Return the files of one side of the pairs, by the names of the pairs."""
    found: dict[str, str] = {}
    for path in clouds:
        name = path.stem.removesuffix(end)
        if name in found and name != path.stem:
            raise _ambiguous(
                folder, f"{found[name]} and {path.name} are both {name}{end}; keep one"
            )
        if name != path.stem:
            found[name] = path.name
    return found


def _is_results(path: Path) -> bool:
    """Tell whether a file is a table of results, such as that of an earlier call."""
    if path.suffix.lower() != ".csv":
        return False
    with path.open("rb") as stream:
        return stream.readline(len(RESULTS)) == RESULTS


def _ambiguous(folder: Path, message: str) -> dcreg.InputError:
    return dcreg.InputError(f"{folder}: {message}, or list the pairs in {folder / TABLE}")


def in_order(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers by value: scan2 comes before scan10."""
    return [
        (int(part or 0), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)
    ]
