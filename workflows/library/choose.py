"""Select problems by name."""

from __future__ import annotations

from collections.abc import Sequence

from data.library.problem import Problem, all_problems, find_problem


def chosen(names: Sequence[str] | None) -> list[Problem]:
    """Return the problems with these names or prefixes of names; all by default.

    Raises
    ------
    LibraryError
        If a name fits no problem.
    """
    known = all_problems()
    if not names:
        return list(known.values())
    found: dict[str, Problem] = {}
    for name in names:
        exact = [key for key in known if name in (key, key.partition("@")[0])]
        fitting = exact or [key for key in known if key.startswith(name)]
        found |= {key: known[key] for key in fitting} or {name: find_problem(name)}
    return list(found.values())
