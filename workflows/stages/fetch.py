"""Fetch the files that the instances of a chunk need."""

from __future__ import annotations

import json
from pathlib import Path

from data import registry
from dcreg.files import whole_file
from workflows.stages.generate import raw_instance
from workflows.stages.plan import Chunk


def fetch(chunk: Chunk, out: Path) -> None:
    """Fetch and verify the files of a chunk, and write their licences and citations to `out`."""
    cards = {name: registry.dataset(name).card for name in chunk.datasets}
    for spec in chunk.instances:
        if cards[spec.dataset].files:
            raw_instance(spec)
    note = [
        {"dataset": name, "licence": card.licence, "citation": card.citation}
        for name, card in cards.items()
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as part:
        part.write_text(json.dumps(note, indent=1), encoding="utf-8")
