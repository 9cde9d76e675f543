"""Random small problems for property tests, among them the awkward ones."""

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st

import dcreg
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Boxes
from tests.oracles.kernels import objective

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


SEEDS = st.integers(0, 2**32 - 1)
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
def cloud_pairs(draw, dim, kinds=(), max_points=6):
    """Source, target and 1 <= n_inliers <= min(n, m); `kinds` are added to `KINDS`."""
    generator = np.random.default_rng(draw(SEEDS))
    n, m = draw(st.integers(1, max_points)), draw(st.integers(1, max_points))
    kind = draw(st.sampled_from([*KINDS, *kinds]))
    source, target = cloud(generator, n, dim, kind), cloud(generator, m, dim, kind)
    both = min(n, m)
    if kind == "noisy copy":
        target[:both] = source[:both] + 0.05 * generator.standard_normal((both, dim))
    elif kind == "mirrored":
        target[:both] = source[:both] * [1.0, 1.0, -1.0]
    elif kind == "with origin":
        source[0] = target[-1] = 0.0
    return source, target, draw(st.integers(1, both))


def centred(points):
    return points - points.mean(axis=0)


def centred_pairs(max_points=6):
    """Centred clouds in 3D, some of them mirrored, and n_inliers."""
    pairs = cloud_pairs(3, kinds=("mirrored",), max_points=max_points)
    return pairs.map(lambda pair: (centred(pair[0]), centred(pair[1]), pair[2]))


def model_of(family, source, target, n_inliers, **settings):
    if family == "similarity2d":
        return Similarity2D(source, target, n_inliers, (0.5, 1.5), **settings)
    return Translation3D(source, target, n_inliers, **settings)


@st.composite
def models(draw, families=("similarity2d", "norm3d"), max_points=6):
    """A model over a random normalised problem."""
    family = draw(st.sampled_from(families))
    points = draw(cloud_pairs(2 if family == "similarity2d" else 3, max_points=max_points))
    model = model_of(family, *points, stationary_box=draw(st.booleans()))
    model.target = points[1]  # for tests that build the same problem again
    return model


@st.composite
def models_with_boxes(draw, **kwargs):
    """A model and a box of random place and size; some axes may have zero width."""
    model, generator = draw(models(**kwargs)), np.random.default_rng(draw(SEEDS))
    dim = model.axis_weights.size
    centre = generator.uniform(-1.5, 1.5, dim)
    half = draw(st.sampled_from([1.0, 0.3, 0.1, 0.01])) * generator.uniform(0.2, 1.0, dim)
    half[generator.random(dim) < 0.15] = 0.0
    return model, Box(centre - half, centre + half)


@st.composite
def facet_boxes(draw, roots, halves=(1.0, 0.5, 0.1, 0.01)):
    """A box inside one of the roots, of any place and size; some axes may have zero width.

    Rotations, the first four axes, and translations have sizes of their own.
    """
    generator = np.random.default_rng(draw(SEEDS))
    root = draw(st.sampled_from(roots))
    centre, half = generator.uniform(-1.0, 1.0, root.dim), generator.uniform(0.2, 1.0, root.dim)
    half[:4] *= draw(st.sampled_from(halves))
    half[4:] *= draw(st.sampled_from(halves))
    half[generator.random(root.dim) < 0.1] = 0.0
    return Box(
        np.clip(centre - half, root.lower, root.upper),
        np.clip(centre + half, root.lower, root.upper),
    )


def box_about(theta, generator, size):
    """A box of 3D poses with theta at its centre, at a vertex, on an edge, or anywhere."""
    dim = len(theta)
    width = size * generator.uniform(0.2, 1.5, dim)
    width[4:7] *= generator.choice([0.0, 0.1, 0.5, 1.0])
    width[np.argmax(np.abs(theta[:4]))] = 0.0
    width[generator.random(dim) < 0.15] = 0.0
    places = (
        np.full(dim, 0.5),
        generator.integers(0, 2, dim),
        generator.choice([0.0, 0.5, 1.0], dim),
        generator.random(dim),
    )
    lower = theta - places[generator.integers(4)] * width
    return Box(np.minimum(lower, theta), np.maximum(lower + width, theta))


def thetas_in(box, count=40):
    """Random parameters of a box, and its vertices."""
    return np.concatenate([box.sample(np.random.default_rng(0), count), box.vertices()])


def minimum_over(model, thetas):
    """Minimum of the reference objective over the admissible parameters; inf if there are none."""
    admissible = thetas[model.admissible(thetas)]
    return min((objective(model, theta) for theta in admissible), default=np.inf)


def lower_bound(bound, box, cutoff=np.inf):
    """The bound of a single box."""
    return bound.evaluate(Boxes.of([box]), cutoff).lower_bounds[0]
