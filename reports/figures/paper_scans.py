"""The paper's figure of 3DMatch: mean error against the overlap of the two scans, per source of scans."""

from __future__ import annotations

from reports.figures import levels
from reports.ledger.evidence import Experiment
from reports.ledger.judging import ledger
from reports.page import Figure
from reports.tables import Tables
from reports.theme import Style

TITLE = "Scans: error against overlap"
CAPTION = (
    "Means over pairs of scans, a column per source that has public clouds. DC-Reg on raw points; the "
    "front end of the others is in their names. Bands: 10 to 90 % of the pairs."
)
DRAWN = ("mean", "band")
METHODS = ("dcreg_scan", "rpm_htb", "goicp", "frs", "gores", "teasers")


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """The figure; None where the experiment has no scans."""
    experiment, known = Experiment(tables), ledger().roles
    methods = [method for role in METHODS for method in experiment.playing(known[role])]
    runs = experiment.runs[experiment.runs["model"].eq("rigid3d")]
    # the published setting: normals as they come, not turned towards the sensor
    published = runs["dataset"].eq("threedmatch") & ~runs["test"].str.endswith("oriented")
    runs = runs[published & runs["method"].isin(methods)]
    if runs.empty:
        return None
    sources = runs["source"].unique()
    runs = (
        levels.prepare(tables, "rigid3d").loc[runs.index].assign(test=runs["source"], row="scans")
    )
    titles = dict.fromkeys(sources, "overlap")
    return levels.assemble("paper-scans", TITLE, runs, styles, scale="linear", x_titles=titles)
