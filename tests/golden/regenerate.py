"""``python -m tests.golden.regenerate``: store the present results as the expected ones.

Run it only after a deliberate change of bound, branching or refinement, read what it prints, and
commit ``golden.json`` and ``bench_counters.json`` together with the change. The latter needs the public
data (``DCREG_DATA_MIRROR``); without them only ``golden.json`` is renewed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.golden import bench_counters
from tests.golden.cases import CASES

GOLDEN = Path(__file__).with_name("golden.json")
COMMAND = "python -m tests.golden.regenerate"
SHOWN = ("status", "n_nodes", "n_assignments")


def stored() -> dict[str, dict[str, Any]]:
    return json.loads(GOLDEN.read_text(encoding="utf-8"))


def main() -> None:
    _store(GOLDEN, {name: case.outcome() for name, case in CASES.items()})
    counted = bench_counters.COUNTED
    missing = [name for name, (_, subject) in counted.items() if not subject.is_here]
    if missing:
        print(f"{bench_counters.STORED.name} is left as it is: no data for {missing[0]}")
        return
    found = {name: bench_counters.outcome(*problem) for name, problem in counted.items()}
    _store(bench_counters.STORED, found)


def _store(path: Path, after: dict[str, dict[str, Any]]) -> None:
    """Write `after` and print what differs from what was stored."""
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    path.write_text(json.dumps(after, indent=1) + "\n", encoding="utf-8")
    for name, outcome in after.items():
        old = before.get(name, {})
        parts = [
            f"{key} {outcome[key]}" + ("" if old.get(key) == outcome[key] else f" (was {old[key]})")
            for key in SHOWN
            if key in old
        ]
        print(f"{name}: {', '.join(parts) or 'new'}")
    for name in before.keys() - after.keys():
        print(f"{name}: gone")


if __name__ == "__main__":
    main()
