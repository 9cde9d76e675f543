"""Find the files that decide what a piece of code does, from its imports and without running it.

Imports count anywhere in a file, also within functions, except imports for type checkers only. A package
stands for what its ``__init__`` and the stub next to it import. The packages around an imported module
are counted too, but their imports are not followed. A string that names files next to the code (a child
process, a data file, a pattern such as ``*/bound*.py`` for modules that are discovered) counts like an
import.

An import graph made by a tool would not do: method folders are no packages, may lie outside the checkout,
and start child processes.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

PACKAGES = ("baselines", "dcreg")  # those that a method may import
_FILE_NAMES = re.compile(r"(\*/)?[A-Za-z][\w*-]*\.\w+")


def files_behind(
    roots: Iterable[Path], checkout: Path, packages: Sequence[str] = PACKAGES
) -> set[Path]:
    """Return the files `roots` and all files of the checkout's packages that they depend on.

    Parameters
    ----------
    roots : paths
        Python files are searched for imports, others only counted.
    checkout : Path
        The folder that holds the packages.
    packages : sequence of str
        Those whose files count.
    """
    counted: set[Path] = set()
    followed: set[Path] = set()
    waiting = list(roots)
    while waiting:
        path = waiting.pop()
        counted.add(path)
        if path.suffix not in (".py", ".pyi") or path in followed:
            continue
        followed.add(path)
        state = path.stat()
        imports, texts = _read(path, state.st_mtime_ns, state.st_size)
        near = (file for text in texts for file in path.parent.glob(text))
        waiting += filter(Path.is_file, [path.with_suffix(".pyi"), *near])
        for level, module, name in imports:
            if level and not path.is_relative_to(checkout):
                continue  # within a method's own folder, which counts anyway
            if level:
                parts = path.relative_to(checkout).parts[:-level]
                module = ".".join([*parts, module] if module else parts)
            if module.partition(".")[0] not in packages:
                continue
            inner = _file_of(f"{module}.{name}", checkout) or _file_of(module, checkout)
            if inner is not None:
                waiting.append(inner)
                counted |= set(_packages_around(inner, checkout))
    return counted


def _file_of(module: str, checkout: Path) -> Path | None:
    stem = checkout.joinpath(*module.split("."))
    paths = (stem / "__init__.py", stem.with_suffix(".py"))
    return next((path for path in paths if path.is_file()), None)


def _packages_around(path: Path, checkout: Path) -> Iterator[Path]:
    for folder in path.relative_to(checkout).parents:
        if (checkout / folder / "__init__.py").is_file():
            yield checkout / folder / "__init__.py"


@functools.cache
def _read(path: Path, *_state: int) -> tuple[set[tuple[int, str, str]], set[str]]:
    """Return imports (level, module, name) and strings that may name files, kept while `_state` lasts."""
    imports, texts = set(), set()
    for node in _nodes(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            imports |= {(0, alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imports |= {(node.level, node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Constant) and _FILE_NAMES.fullmatch(str(node.value)):
            texts.add(str(node.value))
    return imports, texts


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes of a file except those that only type checkers read."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for other in node.orelse:
                yield other
                yield from _nodes(other)
        else:
            yield node
            yield from _nodes(node)
