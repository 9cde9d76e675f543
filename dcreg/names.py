"""The names that users type: models, modes, bounds, kinds of figures.

They stand apart from the code that they select, so that nothing is loaded for a name: `dcreg --help`
must not wait for compiled code. The tables of that code are tested against these lists.
"""

from __future__ import annotations

# Kind of pose: dimension of the points.
MODEL_DIM = {"similarity2d": 2, "rigid3d": 3}

# Of a solve for which no limit is given: long enough for most proofs that come at all.
DEFAULT_TIME_LIMIT_S = 60.0

AUTO = "auto"  # the mode that is chosen by the problem
_MODES = {"similarity2d": ("paper",), "rigid3d": ("full", "paper")}

BOUND_NAMES = (
    "tight",
    "shared",
    "dc",
    "interval",
)
DEFAULT_BOUND = "tight"

# Start boxes of a search, which contain every optimum; the first is the default.
START_BOXES = ("stationary", "radius")

# Suffix of a figure's file: the packages that draw it.
FIGURE_PACKAGES = {
    ".html": ("plotly",),
    ".png": ("plotly", "matplotlib", "seaborn"),
    ".svg": ("plotly", "matplotlib", "seaborn"),
}
# Scores by which `register_matches` selects among the poses that matches agree on; default first.
SCORES = ("correspondences", "surfaces")


def mode_names(model: str) -> list[str]:
    """What ``mode`` takes for a model, beside ``auto``."""
    return list(_MODES[model])


def bound_names() -> list[str]:
    """What ``bound`` takes, beside combinations ``a+b``."""
    return [*BOUND_NAMES]
