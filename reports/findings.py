"""The page ``docs/findings.md``: ``python -m reports findings [ARCHIVE]``.

The page is written from an archive and a template, so that every number on it comes from an archived run.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from dcreg.files import whole_file
from reports import measured, templating, theme
from reports.archive import read
from reports.ledger.evidence import NO_POSE
from reports.measured import Measured
from reports.tables import ReportError, Tables
from workflows import CHECKOUT, archives
from workflows.metrics.errors import SUCCESS_SHARE
from workflows.outcomes import main_machine

HERE = Path(__file__).parent
PAGE = CHECKOUT / "docs" / "findings.md"
EXPERIMENT = "findings"


def archive_of_findings() -> Path:
    """Return the latest archive with runs of the experiment.

    Raises
    ------
    ReportError
        There is none.
    """
    for folder in reversed(archives.folders()):
        if EXPERIMENT in archives.facts(folder)["experiments"]:
            return folder
    raise ReportError(
        f"no archive has runs of the experiment {EXPERIMENT}; make them with `make findings`"
    )


def load(archive: Path) -> tuple[Measured, dict[str, Any]]:
    """Return the archived runs of the experiment, and where they come from."""
    archives.check(archive)
    with TemporaryDirectory() as folder:
        (place,) = read.restore(archive, Path(folder), only=EXPERIMENT)
        tables = Tables.load(place)
        return Measured.of_tables(tables), {**_origin(tables), "archive": archive.name}


def render(found: Measured, origin: dict[str, Any]) -> str:
    """Return the page of these runs."""
    environment = templating.environment()
    environment.autoescape = False
    return environment.get_template("findings.md").render(
        found=found,
        origin=origin,
        separation=measured.separation(found, "similarity2d"),
        effects=measured.effects(found, "similarity2d"),
        n_inliers=measured.effect_of_n_inliers(found),
        norm_stage=measured.norm_stage(found),
        certified_wrong=measured.certified_wrong(found),
        facts=_facts(found.runs),
        threshold=SUCCESS_SHARE,
        no_pose=f"{NO_POSE:g}",
        certified_gap=f"{100 * measured.CERTIFIED_GAP:g} %",
        small=f"{100 * measured.SMALL:g} %",
        coverage=f"{100 * measured.COVERAGE:g} %",
    )


def write(archive: Path, page: Path = PAGE) -> Path:
    """Write the page of an archive; return its path."""
    with whole_file(page) as part:
        part.write_text(render(*load(archive)), encoding="utf-8")
    return page


def _origin(tables: Tables) -> dict[str, Any]:
    known = tables.provenance
    machine = known.get("machine", {})
    limits = {
        label: {key: value for key, value in card.get("limits", {}).items() if value is not None}
        for label, card in tables.cards.items()
    }
    return {
        "experiment": tables.experiment,
        "commands": known.get("commands", []),
        "commit": known.get("git", {}).get("commit", ""),
        "changed": bool(known.get("git", {}).get("dirty")),
        "created": known.get("created", "")[:10],
        "versions": sorted({each for each in tables.runs["fingerprint"] if each}),
        "machine": {key: machine.get(key, "unknown") for key in ("cpu", "cores", "python")},
        "runs_there": int((tables.runs["machine_id"] == main_machine(tables.runs)).sum()),
        "limits": {"time_s": None, "assignments": None} | next(iter(limits.values()), {}),
    }


def _facts(runs: pd.DataFrame) -> list[list[str]]:
    """Return a row per model and test: shapes, levels, trials and points."""
    rows = []
    for (model, test), part in measured.groups(runs, ["model", "test"]):
        rows.append([
            theme.words(test), measured.words_of(model), ", ".join(dict.fromkeys(part["shape"])),
            ", ".join(f"{level:g}" for level in sorted(part["level"].unique())),
            str(part["trial"].nunique()), str(part["instance_id"].nunique()),
        ])  # fmt: skip
    return rows
