"""Brings in the files of a dataset that an experiment needs."""

from __future__ import annotations

import json
from pathlib import Path

from data import registry
from dcreg.files import whole_file
from workflows.stages.generate import raw_instance
from workflows.stages.plan import Plan


def fetch(plan: Plan, dataset_name: str, out: Path) -> None:
    """Fetch and verify what the plan needs of a dataset, and note in `out` the terms it comes on."""
    specs = [
        spec for chunk in plan.chunks for spec in chunk.instances if spec.dataset == dataset_name
    ]
    card = registry.dataset(dataset_name).card
    if card.files:
        for spec in specs:
            raw_instance(spec)
    note = {
        "dataset": dataset_name,
        "instances": len(specs),
        "licence": card.licence,
        "citation": card.citation,
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as part:
        part.write_text(json.dumps(note, indent=1), encoding="utf-8")
