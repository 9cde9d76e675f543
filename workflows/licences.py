"""The licences of all locked packages, as their installed metadata state them.

``python -m workflows.licences OUT``
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from dcreg.files import whole_file
from workflows import CHECKOUT

UNKNOWN, ABSENT = "unknown", "not installed here"
# Licences that ask for the same licence in derived works, in whole or for the changed files.
_COPYLEFT = re.compile(r"GPL|GNU|MPL|Mozilla|EPL|Eclipse|EUPL|CeCILL|CDDL|OSL|-SA\b", re.IGNORECASE)
_PIN = re.compile(r"^([\w.-]+)==(\S+)", re.MULTILINE)
Row = dict[str, str]


def rows(locks: Iterable[Path]) -> list[Row]:
    """Return package, version, licence and note of every package in lock files; the first lock counts.

    The note is "copyleft", `UNKNOWN`, `ABSENT` or empty.
    """
    pins: dict[str, str] = {}
    for lock in locks:
        for name, version in _PIN.findall(lock.read_text(encoding="utf-8")):
            pins.setdefault(name.lower(), version)
    return [_row(name, version) for name, version in sorted(pins.items())]


def _row(name: str, version: str) -> Row:
    try:
        facts = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return {"package": name, "version": version, "licence": "", "note": ABSENT}
    expression, field = (
        "".join(facts.get_all(key, [])) for key in ("License-Expression", "License")
    )
    text = licence(expression, field, facts.get_all("Classifier", []))
    note = UNKNOWN if not text else "copyleft" if _COPYLEFT.search(text) else ""
    return {"package": name, "version": facts["Version"], "licence": text, "note": note}


def licence(expression: str, field: str, classifiers: Iterable[str]) -> str:
    """Return the licence from a package's metadata; empty if they state none.

    The expression comes first, then the classifiers, then the free text: packages that state all three
    are most exact in this order. Of a text of several lines the first one counts.
    """
    listed = [entry.split(" :: ")[-1] for entry in classifiers if entry.startswith("License ::")]
    named = " / ".join(entry for entry in listed if entry != "OSI Approved")
    lines = [line.strip() for line in field.splitlines() if line.strip(" =-")]
    text = expression or named or next(iter(lines), "")
    return "" if text.upper() == "UNKNOWN" else text


def main(out: Path) -> None:
    """Print the table, write it to `out` as CSV, and list what needs a look."""
    found = rows(sorted(CHECKOUT.glob("requirements*.lock")))
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["package", "version", "licence", "note"])
        writer.writeheader()
        writer.writerows(found)
    for row in found:
        print(f"{row['package']:<40} {row['version']:<20} {row['licence'] or row['note']}")
    print()
    for note in ("copyleft", UNKNOWN, ABSENT):
        names = [row["package"] for row in found if row["note"] == note]
        print(f"{note}: {len(names)}{': ' * bool(names)}{', '.join(names)}")
    print(f"{len(found)} packages; {out}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
