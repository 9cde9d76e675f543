"""Globally optimal point cloud registration with the holistic DC bound (DC-Reg, arXiv 2603.25442).

`register` and `sweep` solve, `verify` checks a certificate apart from the search, `read_points` opens
files; results print themselves, and are written and drawn by `Result.write_json`, `plot_registration`
and their like. All public names are in ``__init__.pyi``; each is loaded when it is first used, so that
``import dcreg`` costs next to nothing.
"""

import lazy_loader

from dcreg._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
