"""Problems from the generator of the paper, over the shapes that this project owns."""

from __future__ import annotations

from collections.abc import Iterator

from data.registry import dataset
from workflows.disturb import make_instance
from workflows.library.draft import DECIMALS, Draft

SHAPES = ("fish", "glyph", "pony", "saurian")
# test: (points, levels)
GRID: dict[str, tuple[tuple[int, tuple[float, ...]], ...]] = {
    "deformation": ((60, (0.01, 0.03, 0.05)), (100, (0.02, 0.05))),
    "noise": ((60, (0.01, 0.03, 0.05)), (100, (0.02, 0.05))),
    "mixed_outliers": ((60, (0.1, 0.2, 0.3, 0.5)), (100, (0.1, 0.3))),
    "separate_outliers": ((60, (0.1, 0.2, 0.3, 0.5)), (100, (0.1, 0.3))),
    "occlusion_outliers": ((60, (0.1, 0.3, 0.5)),),
}
WORDS = {
    "deformation": "a smooth deformation of",
    "noise": "noise of",
    "mixed_outliers": "outliers among the shape, in proportion",
    "separate_outliers": "outliers next to the shape, in proportion",
    "occlusion_outliers": "separate outliers, and a share of the target occluded of",
}


def generated() -> Iterator[Draft]:
    """Yield one problem for each shape, test, size and level."""
    for test, sizes in GRID.items():
        for n_points, levels in sizes:
            for level in levels:
                for shape in SHAPES:
                    yield _draft(shape, test, n_points, level)


def _draft(shape: str, test: str, n_points: int, level: float) -> Draft:
    raw = make_instance(dataset("embedded"), shape, test, level, 0, n_points)
    short = test.removesuffix("_outliers")
    return Draft(
        f"{shape}-{n_points}-{short}-{round(100 * level):02d}", "paper",
        f"{shape.capitalize()} with {n_points} points: {WORDS[test]} {level:g}",
        f"workflows.disturb: embedded, {shape}, {test}, level {level:g}, trial 0",
        raw.source.round(DECIMALS), raw.target.round(DECIMALS), raw.pairs, len(raw.pairs),
        scale_range=raw.scale_range,
    )  # fmt: skip
