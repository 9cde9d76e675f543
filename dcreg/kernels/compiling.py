"""The one way kernels are compiled: cached on disk, and free of Python's lock so threads can run."""

from __future__ import annotations

from typing import Any

import numba as nb

jit: Any = nb.njit(cache=True, nogil=True)
