"""Build every page from an archive: reports of experiments, ledger and figures, without a run."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pandas as pd

from reports import claims, paper_page, templating
from reports.archive import clouds, read
from reports.build import build as build_report
from reports.history import page as history_page
from workflows.archives import RUNS
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
    page.write_text(
        templating.environment()
        .get_template("archive.html")
        .render(
            facts=facts,
            counts={name: found[name] for name in OUTCOMES if name in found},
            clouds=clouds.sentences(facts),
        ),
        encoding="utf-8",
    )
    return page
