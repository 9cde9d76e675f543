"""Globally optimal point cloud registration by branch and bound (after DC-Reg, arXiv 2603.25442).

`register`, `sweep` and `register_matches` solve, `verify` checks a certificate independently of the
search, and `read_points` reads files. Results are printed by ``print``, written by `Result.write_json`
and drawn by `plot_registration`. ``__init__.pyi`` lists all public names. Each is loaded when it is first
used, so ``import dcreg`` is fast.
"""

import lazy_loader

from dcreg._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
