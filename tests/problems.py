"""Random small problems for property tests, among them the awkward ones."""

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st

import dcreg
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box

OPTION_NAMES = {field.name for field in dataclasses.fields(dcreg.SolveOptions)}


def keywords(**settings: Any) -> dict[str, Any]:
    """Keywords of `dcreg.register` from settings in which options stand with the others."""
    options = {name: settings.pop(name) for name in OPTION_NAMES & settings.keys()}
    return {**settings, "options": dcreg.SolveOptions(**options)}


def register(*clouds: np.ndarray, **settings: Any) -> dcreg.Result:
    """`dcreg.register`, with options among the other keywords."""
    return dcreg.register(*clouds, **keywords(**settings))


def sweep(*given: Any, **settings: Any) -> dcreg.SweepResult:
    """`dcreg.sweep`, with options among the other keywords."""
    return dcreg.sweep(*given, **keywords(**settings))


KINDS = ["general", "duplicates", "collinear", "noisy copy", "grid"]


def cloud(generator, size, dim, kind):
    points = generator.standard_normal((size, dim))
    if kind == "duplicates":
        points[size // 2 :] = points[0]
    elif kind == "collinear":
        points = points[:, :1] * np.ones(dim) + 0.1
    elif kind == "grid":  # many ties
        points = np.round(points)
    return points


@st.composite
def models(draw, families=("similarity2d", "norm3d"), max_points=6):
    """A model over a random normalised problem with 1 <= n_inliers <= min(n, m)."""
    family = draw(st.sampled_from(families))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, m = draw(st.integers(1, max_points)), draw(st.integers(1, max_points))
    kind = draw(st.sampled_from(KINDS))
    dim = 2 if family == "similarity2d" else 3
    source = cloud(generator, n, dim, kind)
    target = cloud(generator, m, dim, kind)
    if kind == "noisy copy":
        both = min(n, m)
        target[:both] = source[:both] + 0.05 * generator.standard_normal((both, dim))
    n_inliers = draw(st.integers(1, min(n, m)))
    if family == "similarity2d":
        model = Similarity2D(
            source, target, n_inliers, (0.5, 1.5), stationary_box=draw(st.booleans())
        )
    else:
        model = Translation3D(source, target, n_inliers, stationary_box=draw(st.booleans()))
    model.target = target  # for tests that build the same problem anew
    return model


@st.composite
def boxes(draw, dim):
    """A box of random place and size; some axes may have zero width."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    centre = generator.uniform(-1.5, 1.5, dim)
    half = draw(st.sampled_from([1.0, 0.3, 0.1, 0.01])) * generator.uniform(0.2, 1.0, dim)
    half[generator.random(dim) < 0.15] = 0.0
    return Box(centre - half, centre + half)


@st.composite
def models_with_boxes(draw, **kwargs):
    model = draw(models(**kwargs))
    return model, draw(boxes(model.axis_weights.size))
