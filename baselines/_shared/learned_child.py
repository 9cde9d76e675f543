"""The child process of a learned method, with its own interpreter and libraries.

Run as ``python learned_child.py RUNNER SETTINGS``. RUNNER is a file that defines
``load(checkout, weights, settings)``, which returns a function from a problem (dict of arrays) to a
(4, 4) pose. SETTINGS is a JSON object with ``checkout``, ``weights`` and the method's options. The child
needs only the standard library, NumPy and Python 3.7 or later. See `baselines._shared.learned` for the
protocol.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import json
import os
import random
import signal
import sys
import traceback
from typing import Any, TextIO

import numpy as np


def main() -> None:
    _die_with_parent()
    answers = _take_stdout()
    runner, settings = sys.argv[1], json.loads(sys.argv[2])
    # otherwise modules in this file's folder could shadow those of the checkout
    sys.path[0] = settings["checkout"]
    os.chdir(settings["checkout"])
    try:
        spec = importlib.util.spec_from_file_location("runner", runner)
        if spec is None or spec.loader is None:
            raise ImportError("%s is not a Python file" % runner)  # noqa: UP031
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        register = module.load(settings["checkout"], settings["weights"], settings)
    except BaseException as error:
        _answer(answers, error=_described(error))
        return
    _answer(answers, ready=True)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            with np.load(request["input"]) as arrays:
                problem = {name: arrays[name] for name in arrays.files}
            _seed(int(problem["seed"]))
            np.savez(request["output"], T_target_source=np.asarray(register(problem), dtype=float))
        except BaseException as error:
            _answer(answers, error=_described(error))
        else:
            _answer(answers, ok=True)


def _die_with_parent() -> None:
    """End with the parent, also during a computation, which does not see the end of the input (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def _take_stdout() -> TextIO:
    """Return the stream of answers; output of the checkout goes to stderr instead."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return answers


def _answer(answers: TextIO, **content: Any) -> None:
    answers.write(json.dumps(content) + "\n")
    answers.flush()


def _described(error: BaseException) -> str:
    traceback.print_exc()
    return "%s: %s" % (type(error).__name__, error)  # noqa: UP031


def _seed(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    seed_torch = getattr(sys.modules.get("torch"), "manual_seed", None)
    if seed_torch is not None:
        seed_torch(seed)


if __name__ == "__main__":
    main()
