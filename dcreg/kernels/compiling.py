"""The one way kernels are compiled: cached on disk, and free of Python's lock so threads can run."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path
from typing import Any

import numba as nb

HERE = Path(__file__).parent


def _drop_stale_cache() -> None:
    """Remove compiled kernels of other sources.

    Numba recompiles a function when its own file changes, not when a kernel it calls in another file
    does: after an update old and new kernels would mix.
    """
    sources = b"".join(path.read_bytes() for path in sorted(HERE.glob("*.py")))
    digest = hashlib.sha256(sources).hexdigest()
    stamp = HERE / "__pycache__" / "kernels.digest"
    with contextlib.suppress(
        OSError
    ):  # a read-only installation has no cache of its own to go stale
        if stamp.is_file() and stamp.read_text() == digest:
            return
        for index in stamp.parent.glob("*.nb[ic]"):
            index.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest)


_drop_stale_cache()
jit: Any = nb.njit(cache=True, nogil=True)
# For reductions over finite numbers whose order is free: lets the compiler vectorise a minimum.
jit_reduction: Any = nb.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
