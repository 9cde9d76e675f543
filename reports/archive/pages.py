"""Build every page from an archive: reports of experiments, ledger and figures, without a run."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pandas as pd

from reports import claims, paper_page, templating
from reports.archive import clouds, read
from reports.build import build as build_report
from reports.history import page as history_page
from reports.ledger.intervals import NOT_RUN, OPEN
from workflows.archives import RUNS
from workflows.blocks import EVIDENCE, FORECASTS, OPEN_CLAIMS, RUN_HOURS, VERDICTS
from workflows.outcomes import OUTCOMES


def build(archive: str, out: Path, sha256: str = "") -> Path:
    """Write all pages of an archive to the folder `out`; return the path of their index.

    Parameters
    ----------
    archive : str
        As in `read.folder_of`.
    out : Path
    sha256 : str
        Of a zip file.
    """
    folder = read.folder_of(archive, out / "cache", sha256)
    places = read.restore(folder, out)
    history_page.build(out / "history")  # the reports link to it
    with ProcessPoolExecutor(mp_context=get_context("forkserver")) as pool:
        pages = [place.parent / "report" / "index.html" for place in places]
        reports = [pool.submit(build_report, *each) for each in zip(places, pages, strict=True)]
        figures = pool.submit(paper_page.build, out / "figures", [out])
        claims.check([out], out / "claims")
        for report in reports:
            report.result()
        figures.result()
    return _index(folder, out)


def _index(folder: Path, out: Path) -> Path:
    facts = read.facts(folder)
    runs = pd.read_parquet(folder / RUNS, columns=["experiment", "outcome"])
    found = pd.crosstab(runs["experiment"], runs["outcome"])
    page = out / "index.html"
    forecasts = _forecasts(out / EVIDENCE / FORECASTS)
    verdicts = _rows(out / EVIDENCE / VERDICTS)
    page.write_text(
        templating.environment()
        .get_template("archive.html")
        .render(
            facts=facts,
            counts={name: found[name] for name in OUTCOMES if name in found},
            clouds=clouds.sentences(facts),
            forecasts=forecasts,
            logged=sum(row["actual_s"] for row in forecasts),
            spent=float(list(verdicts[0])[-1]) if verdicts else 0.0,
            verdicts=verdicts,
            open_claims=_open(out),
        ),
        encoding="utf-8",
    )
    return page


def _rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table as texts."""
    if not path.is_file():
        return []
    table = pd.read_csv(path, dtype=str).fillna("")
    return [
        {str(name): str(value) for name, value in row.items()} for row in table.to_dict("records")
    ]


def _open(out: Path) -> list[dict[str, str]]:
    """Return what the claims need that the archive leaves open."""
    path = out / "claims" / "claims.csv"
    judged = {row["id"]: row["verdict"] for row in _rows(path)}
    rows = [row | {"verdict": judged[row["claim"]]} for row in _rows(out / EVIDENCE / OPEN_CLAIMS)]
    for row in rows:  # earlier archives have another name of the column
        row.setdefault(RUN_HOURS, row.get("hours of CPU", ""))
    return [row for row in rows if row["verdict"] in (OPEN, NOT_RUN)]


def _forecasts(path: Path) -> list[dict[str, Any]]:
    """Return hours of run time per experiment, forecast and actual, of whole steps of evidence."""
    if not path.is_file():
        return []
    steps = pd.read_csv(path)
    steps = steps[~(steps["runs"] < steps["planned"])] if "planned" in steps else steps
    hours = steps.groupby("experiment")[["forecast_s", "actual_s"]].sum() / 3600
    sums = hours.assign(steps=steps.groupby("experiment").size()).reset_index()
    return [{str(name): value for name, value in row.items()} for row in sums.to_dict("records")]
