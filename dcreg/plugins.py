"""What other packages and folders add to the benchmark.

An installed package names its methods, datasets and metrics, the entry points, in ``pyproject.toml``::

    [project.entry-points."dcreg.baselines"]
    my_method = "my_package.my_method"

The name is that of the method; the value is the Python package, or module, that has its files. Nothing is
imported to find them.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import ModuleType


class PluginError(ValueError):
    """The package of an entry point is missing; the message names it and its distribution."""


@dataclass(frozen=True)
class Plugin:
    """One entry point.

    Attributes
    ----------
    name : str
        Of the method, the dataset or the metrics.
    module : str
        Dotted name of the package or module with the files.
    distribution : str
        Name of the distribution, as in ``pip list``.
    origin : str
        Distribution with version, and entry point, for messages.
    """

    name: str
    module: str
    distribution: str
    origin: str

    @property
    def files(self) -> Path:
        """The folder of the package, or the file of the module.

        Raises
        ------
        PluginError
        """
        top, *inner = self.module.split(".")
        try:
            spec = importlib.util.find_spec(top)
        except (ImportError, ValueError):
            spec = None
        places = list(spec.submodule_search_locations or ()) if spec else []
        if spec and spec.origin and not places:
            places = [spec.origin.removesuffix(".py")]  # a single module
        for place in places:
            path = Path(place, *inner)
            if path.is_dir() or (path := path.with_suffix(".py")).is_file():
                return path
        raise PluginError(
            f"{self.origin}: there is no package {self.module}; correct the entry point, or install "
            "the package again"
        )

    @property
    def package(self) -> Path:
        """The outermost package around `files`, or the single file of a module.

        Raises
        ------
        PluginError
        """
        path = self.files
        for _ in self.module.split(".")[1:]:
            path = path.parent
        return path


def plugins(group: str) -> list[Plugin]:
    """Return the entry points of a group, such as ``dcreg.baselines``, sorted by name and origin."""
    return list(_plugins(group, tuple(sys.path)))


@functools.cache
def _plugins(group: str, path: tuple[str, ...]) -> tuple[Plugin, ...]:
    """Search the distributions on `path` once."""
    found = [_plugin(point) for point in metadata.entry_points(group=group)]
    return tuple(sorted(set(found), key=lambda plugin: (plugin.name, plugin.origin)))


def _plugin(point: metadata.EntryPoint) -> Plugin:
    name, version = (point.dist.name, point.dist.version) if point.dist else ("unknown", "")
    entry = f"entry point {point.name} = {point.value} of {point.group}"
    return Plugin(point.name, point.module, name, f"package {name} {version} ({entry})")


def files_of(plugin: Plugin) -> list[Path]:
    """Return all files of the package of a plug-in except compiled ones; none if it is missing."""
    try:
        package = plugin.package
    except PluginError:
        return []
    return files_under(package) if package.is_dir() else [package]


def files_under(folder: Path) -> list[Path]:
    """Return all files of a folder and its subfolders except compiled ones, sorted."""
    paths = sorted(folder.rglob("*"))
    return [path for path in paths if path.is_file() and "__pycache__" not in path.parts]


def import_file(path: Path) -> ModuleType:
    """Import a Python file that belongs to no package, once."""
    name = f"_elsewhere.{hashlib.sha1(str(path).encode()).hexdigest()}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look up the module of their class
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
