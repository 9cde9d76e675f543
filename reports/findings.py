"""The page ``docs/findings.md``: ``python -m reports findings [TABLES…]``.

With tables of experiments, the few columns that the page needs are first stored in ``docs/measured``. The
page is then written from these files and a template, so that every number on it comes from a run.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from dcreg.files import whole_file
from reports import measured, templating, theme
from reports.measured import Measured
from reports.tables import ReportError, Tables
from workflows import CHECKOUT
from workflows.metrics.errors import SUCCESS_SHARE

HERE = Path(__file__).parent
FOLDER = CHECKOUT / "docs" / "measured"
PAGE = CHECKOUT / "docs" / "findings.md"
MAX_BYTES = 200_000  # of the committed tables
_FILES = ("runs.csv", "stages.csv", "origin.json")


def store(folders: Sequence[Path], out: Path = FOLDER) -> None:
    """Write what the page needs from the tables in `folders` to `out`.

    Raises
    ------
    ReportError
        If the result is too large to be committed.
    """
    tables = [Tables.load(folder) for folder in folders]
    found = [Measured.of_tables(each) for each in tables]
    runs = pd.concat([each.runs[each.stored] for each in found], ignore_index=True)
    # a method is one family in all experiments
    stages = pd.concat([each.stages for each in found], ignore_index=True)
    texts = [
        runs.to_csv(index=False, float_format="%.6g"),
        stages.to_csv(index=False, float_format="%.6g"),
        json.dumps([_origin(each) for each in tables], indent=1) + "\n",
    ]
    size = sum(len(text.encode()) for text in texts)
    if size > MAX_BYTES:
        raise ReportError(
            f"{out}: {size} bytes exceed {MAX_BYTES}; select fewer runs or methods of the experiment"
        )
    out.mkdir(parents=True, exist_ok=True)
    for name, text in zip(_FILES, texts, strict=True):
        with whole_file(out / name) as part:
            part.write_text(text, encoding="utf-8")


def load(folder: Path = FOLDER) -> tuple[Measured, list[dict[str, Any]]]:
    """Return the stored tables and where they come from."""
    runs, stages, origin = (folder / name for name in _FILES)
    texts = {"bound": str, "search": str, "certificate_scope": str}
    table = pd.read_csv(runs, keep_default_na=True, dtype=texts)
    table = table.fillna(dict.fromkeys(texts, ""))
    return Measured(table, pd.read_csv(stages)), json.loads(origin.read_text(encoding="utf-8"))


def render(folder: Path = FOLDER) -> str:
    """Return the page of the stored tables."""
    found, origins = load(folder)
    environment = templating.environment()
    environment.autoescape = False
    return environment.get_template("findings.md").render(
        found=found,
        origins=origins,
        separation=measured.separation(found, "similarity2d"),
        effects=measured.effects(found, "similarity2d"),
        n_inliers=measured.effect_of_n_inliers(found),
        norm_stage=measured.norm_stage(found),
        certified_wrong=measured.certified_wrong(found),
        facts=_facts(found.runs),
        threshold=SUCCESS_SHARE,
        no_pose=f"{measured.NO_POSE_ERROR:g}",
        small=f"{100 * measured.SMALL:g} %",
        coverage=f"{100 * measured.COVERAGE:g} %",
    )


def write(folder: Path = FOLDER, page: Path = PAGE) -> Path:
    """Write the page of the stored tables; return its path."""
    with whole_file(page) as part:
        part.write_text(render(folder), encoding="utf-8")
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
        "machine": {key: machine.get(key, "unknown") for key in ("cpu", "cores", "python")},
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
