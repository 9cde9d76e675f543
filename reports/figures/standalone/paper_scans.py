"""The figure of 3DMatch in the paper: mean error against the overlap of the scans, per source."""

from __future__ import annotations

from reports.figures import levels
from reports.figures.figure import Figure
from reports.ledger.evidence import Experiment
from reports.ledger.judging import ledger
from reports.tables import Tables
from reports.theme import Style

POSITION = 50
TITLE = "Paper: scans, error against overlap"
CAPTION = (
    "Means over pairs of scans; one column per source with public clouds. DC-Reg uses the raw points; "
    "the names of the other methods state their front end. Bands: 10 to 90 % of the pairs."
)
DRAWN = ("mean", "band")
METHODS = ("dcreg_scan", "rpm_htb", "goicp", "frs", "gores", "teasers")


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw the figure; None if the experiment has no scans."""
    experiment, known = Experiment(tables), ledger().roles
    methods = [method for role in METHODS for method in experiment.methods_in(known[role])]
    runs = experiment.runs[experiment.runs["model"].eq("rigid3d")]
    # the published setting: normals are not oriented towards the sensor
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
