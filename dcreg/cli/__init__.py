"""The command line, which uses only public names of `dcreg` and computes nothing itself."""

from __future__ import annotations

import gc
import os
import sys

from dcreg.cli import interrupts


def main() -> None:
    """Run the command ``dcreg``; if a package is missing, say what to install."""
    interrupts.end_at_once()
    _start_fast()
    try:
        from dcreg.cli.program import app

        app(prog_name="dcreg")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("typer", "rich"):
            raise
        sys.exit(
            f"error: the command dcreg needs the package {missing}, which is not installed; install "
            "its packages with: pip install typer rich\n"
            "The Python library (import dcreg) works without them"
        )
    finally:
        gc.freeze()  # at its end Python would search all that is loaded for cycles


def _start_fast() -> None:
    """Avoid work that takes a good part of the processor time of a short command."""
    # The OpenBLAS of NumPy and that of SciPy start one thread per processor each. Such a thread spins for
    # a tenth of a second before it sleeps (2^28 cycles; 4 is the minimum).
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the same for those of the search trees
    # what is loaded stays alive: searching it for cycles time and again finds nothing
    gc.set_threshold(100_000, 20, 100)
