"""The files that decide what a piece of code does, found from its imports without running it.

Followed are imports anywhere in a file, also those within functions, but not those for type checkers
only. A name that a package hands on (``from dcreg.local import fit_pose``) leads to the package's
``__init__`` and to the module that defines it, not to the package's other modules: the library's
``__init__`` hands on everything, and every method would depend on all of it. Where a package defines the
name itself, or is used as a whole, all its imports count. Names that a package loads late stand in the
stub beside its ``__init__``, which is read with it. Texts that name a module of the checkout, or a
file beside the code that reads it (a child process, a data file), count like imports. So do patterns
that match Python files (``*/bound*.py``), by which modules are discovered.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

PACKAGES = ("baselines", "dcreg")  # those that a method may import
_WHOLE = "*"
# The name of a file or a module, or a pattern that matches Python files; as opposed to prose.
_NAME = re.compile(r"[A-Za-z_][\w.-]*|[\w./*-]*\*[\w./*-]*\.py")


@dataclass(frozen=True)
class Import:
    """``from module import name as bound``, or with an empty name ``import module as bound``.

    `uses` are the attributes that the file takes from it; ``*`` stands for the thing as a whole.
    """

    module: str
    name: str
    bound: str
    uses: frozenset[str]


@dataclass
class Source:
    """What one file of Python says.

    Attributes
    ----------
    imports : list of Import
    texts : set of str
        String constants that may name a file or a module.
    """

    imports: list[Import] = field(default_factory=list)
    texts: set[str] = field(default_factory=set)


def files_behind(
    roots: Iterable[Path], checkout: Path, packages: Sequence[str] = PACKAGES
) -> set[Path]:
    """The files `roots` and all files of the checkout's packages that they depend on.

    Parameters
    ----------
    roots : paths
        Python files are searched for imports, others only counted.
    checkout : Path
        The folder that holds the packages.
    packages : sequence of str
        Those whose files count.
    """
    walk = _Walk(checkout, packages)
    for root in roots:
        walk.take(root, _WHOLE)
    return walk.files


class _Walk:
    """From file to file."""

    def __init__(self, checkout: Path, packages: Sequence[str]) -> None:
        self.checkout, self.packages = checkout, packages
        self.files: set[Path] = set()
        self._taken: set[tuple[Path, str]] = set()

    def take(self, path: Path, name: str) -> None:
        """Count a file, and what its `name` depends on, or all of it (``*``)."""
        if (path, _WHOLE) in self._taken or (path, name) in self._taken:
            return
        self.files.add(path)
        self._taken.add((path, name))
        if path.suffix != ".py":
            return
        read = [file for file in (path, path.with_suffix(".pyi")) if file.is_file()]
        self.files.update(read)
        states = tuple((file, file.stat().st_mtime_ns, file.stat().st_size) for file in read)
        source = _read(_module_of(path, self.checkout), states)
        handed_on = [wanted for wanted in source.imports if wanted.bound == name]
        if path.name == "__init__.py" and handed_on:
            for wanted in handed_on:
                self._import(wanted)
        elif name != _WHOLE:  # defined here, perhaps by means of all that is imported
            self.take(path, _WHOLE)
        else:
            for wanted in source.imports:
                self._import(wanted)
            for text in source.texts:
                if "*" in text:
                    for file in path.parent.glob(text):
                        self.take(file, _WHOLE)
                elif (path.parent / text).is_file():
                    self.take(path.parent / text, _WHOLE)
                elif "." in text:
                    self._module(text, {_WHOLE})

    def _import(self, wanted: Import) -> None:
        inner = f"{wanted.module}.{wanted.name}"
        if not wanted.name:
            self._module(wanted.module, wanted.uses)
        elif self._path(inner) is not None:
            self._module(inner, wanted.uses)
        else:
            self._module(wanted.module, {wanted.name})

    def _module(self, module: str, names: Iterable[str]) -> None:
        """Count a module with the packages around it, and what `names` of it depend on."""
        path = self._path(module)
        if path is None:
            return
        parts = module.split(".")
        packages = (self._path(".".join(parts[:end])) for end in range(1, len(parts)))
        self.files.update(filter(None, packages))
        if path.name != "__init__.py":
            self.take(path, _WHOLE)
            return
        for name in names or {_WHOLE}:
            inner = self._path(f"{module}.{name}") if name != _WHOLE else None
            if inner is None:
                self.take(path, name)
            else:
                self.files.add(path)
                self._module(f"{module}.{name}", {_WHOLE})

    def _path(self, module: str) -> Path | None:
        """The file of a module of the checkout."""
        if module.partition(".")[0] not in self.packages:
            return None
        stem = self.checkout.joinpath(*module.split("."))
        paths = (stem / "__init__.py", stem.with_suffix(".py"))
        return next((path for path in paths if path.is_file()), None)


@functools.cache
def _read(module: str, states: tuple[tuple[Path, int, int], ...]) -> Source:
    """What a file and its stub say; read once per process as long as they stay the same.

    `states` are the paths with time and size of what they hold.
    """
    package = module if states[0][0].name == "__init__.py" else module.rpartition(".")[0]
    source = Source()
    nodes = [
        node
        for path, *_ in states
        for node in _nodes(ast.parse(path.read_text(encoding="utf-8"), str(path)))
    ]
    uses = _attributes(nodes)
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                bound = alias.asname or alias.name
                taken = uses.get(bound, set()) if "." not in bound else set()
                source.imports.append(Import(alias.name, "", bound, frozenset(taken)))
        elif isinstance(node, ast.ImportFrom):
            origin = _absolute("." * node.level + (node.module or ""), package)
            for alias in node.names:
                bound = alias.asname or alias.name
                taken = uses.get(bound, set())
                source.imports.append(Import(origin, alias.name, bound, frozenset(taken)))
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and _NAME.fullmatch(node.value)
        ):
            source.texts.add(node.value)
    return source


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a file but those that only type checkers read."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for other in node.orelse:
                yield other
                yield from _nodes(other)
        else:
            yield node
            yield from _nodes(node)


def _attributes(nodes: list[ast.AST]) -> dict[str, set[str]]:
    """For every name of a file the attributes taken from it; ``*`` where it is used by itself."""
    uses: dict[str, set[str]] = {}
    bases = set()
    for node in nodes:  # an attribute comes before its base
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            uses.setdefault(node.value.id, set()).add(node.attr)
            bases.add(node.value)
        elif isinstance(node, ast.Name) and node not in bases:
            uses.setdefault(node.id, set()).add(_WHOLE)
    return uses


def _absolute(module: str, package: str) -> str:
    """The full name of a module that is written relative to `package`."""
    name = module.lstrip(".")
    above = package.split(".")[: 1 - (len(module) - len(name)) or None]
    return name if name == module else ".".join([*above, name]).rstrip(".")


def _module_of(path: Path, checkout: Path) -> str:
    """Name of a file's module; that of a file outside the checkout is its stem."""
    if not path.is_relative_to(checkout):
        return path.stem
    parts = path.relative_to(checkout).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
