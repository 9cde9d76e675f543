"""``python -m tests.golden.regenerate``: store the present results as the expected ones.

Run it only after a deliberate change of bound, branching or refinement, read what it prints, and
commit ``golden.json`` together with the change.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.golden.cases import CASES

GOLDEN = Path(__file__).with_name("golden.json")
COMMAND = "python -m tests.golden.regenerate"
SHOWN = ("status", "n_nodes", "n_assignments")


def stored() -> dict[str, dict[str, Any]]:
    return json.loads(GOLDEN.read_text(encoding="utf-8"))


def main() -> None:
    before = stored() if GOLDEN.exists() else {}
    after = {name: case.outcome() for name, case in CASES.items()}
    GOLDEN.write_text(json.dumps(after, indent=1) + "\n", encoding="utf-8")
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
