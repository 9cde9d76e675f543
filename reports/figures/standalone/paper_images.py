"""The figure of photographs in the paper: edges of the source at each pose, over the target."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from data import registry
from data.contract import DataError, RecordedDataset
from data.photographs import PICTURES, grey
from reports.figures import alignments, clouds
from reports.figures.figure import Figure
from reports.figures.paper import PaperFigure
from reports.tables import Tables
from reports.theme import Style

POSITION = 30
TITLE = "Paper: edges of photographs"
CAPTION = (
    "Edge points of two photographs: both sets, then the source (red circles) at the pose of each method "
    "over the target (blue crosses) and its photograph. A row is one pair of photographs of an object: "
    "the median run of the first method."
)
DRAWN = clouds.DRAWN
TESTS = ("canny", "turned")
PAPER = PaperFigure(
    caption="Canny edges of photographs, the source rotated by 180 degrees, n_p = 0.9 of the smaller "
    "set, with the alignment that each method finds.",
    differs=(
        "The paper uses photographs of Caltech-256 and VOC2007 that it does not name. Ours are those of "
        "the APM release, from the same collections; with a local copy of the collections, a photograph "
        "is also matched with its own rotated copy.",
        "The filter width and the number of edge points are ours.",
        "The errors are measured on manually marked points, which no method receives.",
        "We added DC-Reg (ours).",
    ),
    experiment="paper2d_images",
    command="make paper-2d-images",
    lines=(
        "DC-Reg, n_p × 1/1", "DC-Reg (ours)", "RPM-HTB", "RPM-PA", "RPM-CAV"
    ),
)  # fmt: skip


def build(tables: Tables, styles: dict[str, Style]) -> Figure | None:
    """Draw a row per object and a column per method; None without edges of photographs."""
    methods = list(PAPER.methods(tables).values())
    items = [item for item in tables.overlays if item["test"] in TESTS]
    shapes = dict.fromkeys((item["dataset"], item["shape"]) for item in items)
    rows = [
        (f"{shape}<br>{item['test']} {item['level']:g}", item)
        for dataset, shape in shapes
        if (item := alignments.example(
            [item for item in items if (item["dataset"], item["shape"]) == (dataset, shape)],
            methods,
        ))
    ]  # fmt: skip
    figure = alignments.assemble("paper-images", TITLE, tables, styles, methods, rows, flip=True)
    if figure is None or figure.grid is None:
        return None
    pictures = [photograph(item) for _, item in rows]
    behind = {
        index: picture
        for index, panel in enumerate(figure.grid.panels)
        if panel.column and (picture := pictures[panel.row]) is not None
    }
    return replace(figure, photographs=behind)


def photograph(item: dict[str, Any]) -> np.ndarray | None:
    """Return the photograph of the target in grey; None if its file is not available."""
    try:
        dataset = registry.dataset(item["dataset"])
        assert isinstance(dataset, RecordedDataset)
        files = dataset.files(item["shape"], item["test"], item["level"], item["trial"])
        return grey([file for file in files if file.suffix.lower() in PICTURES][-1])
    except (DataError, LookupError, ValueError):
        return None
