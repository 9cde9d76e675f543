"""Check methods against the contract: ``python -m baselines.check NAME|FOLDER|PACKAGE …``.

NAME is a method, FOLDER contains one method or several, and PACKAGE is an installed package that adds
methods by entry points. Exit code: 0 if no rule is broken, 1 if one is, 2 if there is no such method.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from baselines import registry
from baselines.conformance import folder_rules, solve_rules
from baselines.conformance.candidate import BrokenRuleError, Candidate, NotCheckedError
from baselines.registry import BaselineError
from dcreg.plugins import Plugin, PluginError, plugins

OK, SKIPPED, BROKEN = "ok", "skipped", "BROKEN"


def candidates(text: str) -> list[Candidate]:
    """Return the methods of a name, a folder or a package.

    Raises
    ------
    BaselineError
        There is none.
    """
    if text in registry.names():
        return [Candidate(text)]
    if found := [
        Candidate(plugin.name) for plugin in plugins(registry.GROUP) if _adds(text, plugin)
    ]:
        return found
    folder = Path(text).expanduser().resolve()
    if not folder.is_dir():
        raise BaselineError(
            f"{text}: neither a method, nor a folder, nor an installed package with entry points of the "
            f"group {registry.GROUP}; `make baselines` lists all methods"
        )
    if folder.name in registry.names(folder.parent):
        return [Candidate(folder.name, folder.parent)]
    if names := registry.names(folder):
        return [Candidate(name, folder) for name in names]
    if (folder / "pyproject.toml").is_file():
        raise BaselineError(
            f"{text}: a package that is not installed in editable mode; run "
            f"`{os.path.relpath(sys.executable)} -m pip install --no-deps --no-build-isolation "
            f"--editable {text}`, or give the name of an installed package"
        )
    raise BaselineError(
        f"{text}: no card.yaml and adapter.py here or in a subfolder; name the folder of a method"
    )


def _adds(text: str, plugin: Plugin) -> bool:
    """Whether a plug-in belongs to the distribution, package or project folder of this name."""
    known = plugin.distribution, plugin.module.partition(".")[0]
    if _normalised(text) in map(_normalised, known):
        return True
    folder = Path(text).expanduser().resolve()
    if not (folder / "pyproject.toml").is_file():
        return False
    with suppress(PluginError):
        return plugin.package.is_relative_to(folder)
    return False


def _normalised(name: str) -> str:
    return re.sub("[-_.]+", "-", name).lower()


def results(method: Candidate) -> Iterator[tuple[str, str, str]]:
    """Yield the result of each rule, the rule, and why it is broken or was not checked."""
    try:
        models = method.card.models
        method.load()
    except (BaselineError, ImportError) as error:
        yield BROKEN, "card.yaml and adapter.py can be loaded", str(error)
        return
    for rule in folder_rules.RULES:
        yield _result(partial(rule, method), _words(rule))
    for model in models:
        for solve_rule in solve_rules.RULES:
            yield _result(partial(solve_rule, method, model), f"{model}: {_words(solve_rule)}")


def _words(rule: Callable[..., None]) -> str:
    return (rule.__doc__ or "").strip().splitlines()[0].rstrip(".")


def _result(check: Callable[[], None], words: str) -> tuple[str, str, str]:
    try:
        check()
    except BrokenRuleError as error:
        return BROKEN, words, str(error)
    except NotCheckedError as error:
        return SKIPPED, words, str(error)
    except Exception as error:  # what the method raises
        return BROKEN, words, f"{type(error).__name__}: {error}"
    return OK, words, ""


def _place(method: Candidate) -> str:
    if method.root is None:
        return registry.origin_of(method.name)
    return registry.shown(method.root / method.name)


def main(texts: Sequence[str]) -> int:
    """Print a line per rule and a summary per method; return the exit code."""
    if not texts or texts[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if texts else 2
    try:
        methods = [method for text in texts for method in candidates(text)]
    except BaselineError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    n_broken = 0
    for method in methods:
        print(f"{method.name}: {_place(method)}")
        counts = dict.fromkeys((OK, SKIPPED, BROKEN), 0)
        for result, words, reason in results(method):
            counts[result] += 1
            print(
                f"  {result:<8} {words}" + (f"\n           {reason}" if reason else ""), flush=True
            )
        print(f"  {counts[OK]} rules kept, {counts[BROKEN]} broken, {counts[SKIPPED]} not checked")
        n_broken += counts[BROKEN]
    return 1 if n_broken else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
