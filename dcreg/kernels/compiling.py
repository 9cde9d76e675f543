"""The one way kernels are compiled: cached on disk, and free of Python's lock so threads can run."""

from __future__ import annotations

from typing import Any

import numba as nb

jit: Any = nb.njit(cache=True, nogil=True)
# For reductions over finite numbers whose order is free: lets the compiler vectorise a minimum.
jit_reduction: Any = nb.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
