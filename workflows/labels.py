"""The displayed name of each method of an experiment: the same in terminal, tables and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from baselines import registry
from workflows.config import MethodSettings, with_note


def display_names(methods: Iterable[MethodSettings]) -> dict[str, str]:
    """Return the displayed name of each method of an experiment, by its key.

    Methods with the same name get the options in which they differ as a note. If there are none, they get
    their key.
    """
    methods = list(methods)
    groups: dict[str, list[MethodSettings]] = {}
    for method in methods:
        groups.setdefault(display_name(method), []).append(method)
    names: dict[str, str] = {}
    for name, group in groups.items():
        notes = _differences(group) if len(group) > 1 else {}
        names |= {each.name: with_note(name, notes.get(each.name, "")) for each in group}
    return distinct({method.name: names[method.name] for method in methods})


def display_name(method: MethodSettings) -> str:
    """Return the name of a single method: its label, or the card's name with an unusual n_inliers.

    A reconstruction is always marked as such.
    """
    card = registry.read_card(method.baseline)
    if method.label:
        is_unmarked = (
            card.provenance == "reconstruction" and "reconstruct" not in method.label.lower()
        )
        return f"{method.label} (reconstructed)" if is_unmarked else method.label
    ratio = method.n_inliers_ratio
    return with_note(card.display_name, "" if ratio == 1 else f"n_p × {ratio:g}")


def distinct(names: Mapping[str, str]) -> dict[str, str]:
    """Return names by key; a name that several methods share is followed by the key."""
    counts = Counter(names.values())
    return {
        key: name if name and counts[name] == 1 else f"{name} [{key}]".strip()
        for key, name in names.items()
    }


def _differences(group: list[MethodSettings]) -> dict[str, str]:
    """Return the settings of each method that not all methods of a group share."""
    settings = {
        each.name: {**each.options, **({"n_points": each.n_points} if each.n_points else {})}
        for each in group
    }
    keys = dict.fromkeys(key for given in settings.values() for key in given)
    differing = [
        key for key in keys if len({str(given.get(key)) for given in settings.values()}) > 1
    ]
    return {
        name: ", ".join(
            f"{key.replace('_', ' ')} {given[key]}" for key in differing if key in given
        )
        for name, given in settings.items()
    }
