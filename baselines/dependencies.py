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
import atexit
import contextlib
import functools
import hashlib
import json
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from dcreg.files import write_text

PACKAGES = ("baselines", "dcreg")  # those that a method may import
_STORE = Path(__file__).parent / "__pycache__" / "imports.json"
_Found = tuple[Sequence[tuple[int, str, str]], Sequence[str]]
_MOST_STORED = 5000  # files; then the store begins anew
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
    file_of = functools.cache(functools.partial(_file_of, checkout=checkout))  # for this call only
    around: set[Path] = set()
    reached: set[Path] = set()
    waiting = list(roots)
    while waiting:
        path = waiting.pop()
        if path in reached:
            continue
        reached.add(path)
        if path.suffix not in (".py", ".pyi"):
            continue
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
            inner = file_of(f"{module}.{name}") or file_of(module)
            if inner is not None and inner not in reached:
                waiting.append(inner)
                around.update(_packages_around(inner, checkout))
    return reached | around


def _file_of(module: str, checkout: Path) -> Path | None:
    stem = checkout.joinpath(*module.split("."))
    paths = (stem / "__init__.py", stem.with_suffix(".py"))
    return next((path for path in paths if path.is_file()), None)


def _packages_around(path: Path, checkout: Path) -> Iterator[Path]:
    for folder in path.relative_to(checkout).parents:
        if (checkout / folder / "__init__.py").is_file():
            yield checkout / folder / "__init__.py"


@functools.cache
def _read(path: Path, *_state: int) -> _Found:
    """Return imports (level, module, name) and strings that may name files, kept while `_state` lasts."""
    source = path.read_bytes()
    key = hashlib.sha256(source).hexdigest()
    stored = _stored()
    if key not in stored:
        stored[key] = _found_in(ast.parse(source, str(path)))
    return stored[key]


def _found_in(tree: ast.AST) -> _Found:
    imports, texts = set(), set()
    for node in _nodes(tree):
        if isinstance(node, ast.Import):
            imports |= {(0, alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imports |= {(node.level, node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Constant) and _FILE_NAMES.fullmatch(str(node.value)):
            texts.add(str(node.value))
    return sorted(imports), sorted(texts)


@functools.cache
def _stored() -> dict[str, _Found]:
    """Return what earlier processes found, by the digest of a file: to parse all files takes long."""
    try:
        content = json.loads(_STORE.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        content = {}
    is_valid = content.get("by") == _version() and len(content["found"]) <= _MOST_STORED
    stored: dict[str, _Found] = content["found"] if is_valid else {}
    atexit.register(_store, stored, len(stored))
    return stored


def _store(stored: dict[str, _Found], known: int) -> None:
    """Write what was found if it is more than what was known."""
    if len(stored) > known and not sys.dont_write_bytecode:
        text = json.dumps({"by": _version(), "found": stored})
        with contextlib.suppress(OSError):
            write_text(_STORE, text)


def _version() -> str:
    """Return the digest of this file, which decides what is found."""
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes of a file except those that only type checkers read."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
        else:
            waiting += ast.iter_child_nodes(node)
