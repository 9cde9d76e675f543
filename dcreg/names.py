"""The names that users type: models, modes, bounds, start boxes, scores, kinds of figures.

They are separate from the code that they select, so that `dcreg --help` does not load compiled code.
Tests compare these lists with the tables of that code.
"""

from __future__ import annotations

import re
from pathlib import Path

_FAMILIES = Path(__file__).parent / "families"

# Kind of pose: dimension of the points.
MODEL_DIM = {"similarity2d": 2, "rigid3d": 3, "similarity3d": 3}

# Default time limit, long enough for most searches that close at all.
DEFAULT_TIME_LIMIT_S = 60.0
# Default share of the upper bound at which a gap counts as closed.
DEFAULT_REL_GAP = 0.01
# Default ratio of objectives up to which another pose is nearly as good as the best one.
DEFAULT_RATIO = 1.5

# Reason of status ``converged``, shared by results and warnings.
NO_PROOF_EXPECTED = "proof not expected soon"
MAX_RMS_MET = "a pose within max_rms was found"
MAX_RMS_SLACK = 1e-9  # relative; an RMS residual above `max_rms` by less meets it, up to rounding
WITHIN_TOLERANCE = "fits within the tolerance"
COMPILING = (
    "compiling the kernels that this search needs (only once; they are cached for later runs)"
)

AUTO = "auto"  # the library chooses: the mode, or the number of pairs

# Numbers of pairs of a sweep by default, as shares of the smaller cloud.
SWEEP_SHARES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
SWEEP_TEXT = ",".join(map(str, SWEEP_SHARES))

BOUND_NAMES = ("tight", "shared", "dc", "interval")
DEFAULT_BOUND = "tight"
_BOUNDS_OF_MODES = ("rigid", "rotation", "similarity")  # of modes that accept no other bound
_NAME = re.compile(r'^    name(?:, \w+)* = "([\w-]+)"', re.M)  # of the class of a bound

# Start boxes of a search, which contain every optimum; the first is the default.
START_BOXES = ("stationary", "radius")

# Scopes in which the certified objective is that of `dcreg.objective`.
SIMILARITY_POSE, RIGID_POSE = POSE_SCOPES = ("similarity pose", "rigid pose")
# Scopes in which it is at most that: norms differ by at most the distance of the points.
(NORM_TRANSLATION,) = NORM_SCOPES = ("translation in norm space",)
OF_SAMPLE = " of the sample"  # after the scope, if the bounds do not hold for all points

# Suffix of a figure's file and the packages that draw it.
FIGURE_PACKAGES = {
    ".html": ("plotly",),
    ".png": ("plotly", "matplotlib", "seaborn"),
    ".svg": ("plotly", "matplotlib", "seaborn"),
}
# Suffixes of the files of points that are written.
CLOUD_SUFFIXES = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".npy", ".npz")
# Suffixes of the files of points that are read.
READ_SUFFIXES = (*CLOUD_SUFFIXES, ".mat", ".off", ".las", ".laz", ".e57")
# Scores by which `register_matches` selects among the poses that matches agree on; default first.
SCORES = ("correspondences", "surfaces")


def mode_files() -> dict[tuple[str, str], Path]:
    """Return the files ``mode_MODEL_NAME.py`` of the families, by model and name of the mode."""
    return {
        (model, path.stem.removeprefix(f"mode_{model}_")): path
        for model in MODEL_DIM
        for path in sorted(_FAMILIES.glob(f"*/mode_{model}_*.py"), key=lambda path: path.stem)
    }


def mode_names(model: str) -> list[str]:
    """Return the modes of a model, without ``auto``."""
    return [name for of, name in mode_files() if of == model]


def bounds_in(file: Path) -> set[str]:
    """Return the names of the bounds that a file defines."""
    return set(_NAME.findall(file.read_text("utf-8")))


def bound_names() -> list[str]:
    """Return the bounds, without combinations ``a+b``: those of the library, then added ones.

    Their names are read from the source of the families' files ``bound*.py``, which is not imported.
    """
    found = {name for file in _FAMILIES.glob("*/bound*.py") for name in bounds_in(file)}
    return [*BOUND_NAMES, *sorted(found.difference(BOUND_NAMES, _BOUNDS_OF_MODES))]
