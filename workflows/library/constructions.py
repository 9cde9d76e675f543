"""Adversarial problems: symmetry, repetition, near-ties, decoys and small overlap; and tiny problems."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from data.registry import dataset
from data.sampling import normalise
from workflows.disturb import seed_for, warp
from workflows.library.draft import Draft, moved

TINY_KINDS = ("random", "noisy", "regular", "line")


def _rng(name: str) -> np.random.Generator:
    return np.random.default_rng(seed_for("library", name))


def _same(count: int) -> np.ndarray:
    return np.column_stack([np.arange(count)] * 2)


def _shape(name: str, count: int) -> np.ndarray:
    found = dataset("embedded")
    return found.prototype(name, count)  # type: ignore[attr-defined]


# --- symmetry ----------------------------------------------------------------------------------


def _turns(group: str) -> np.ndarray:
    """Return the rotations of a point group: ``2D5`` are five turns in 2D, others as in SciPy."""
    if group.startswith("2D"):
        angles = 2 * np.pi * np.arange(int(group[2:])) / int(group[2:])
        return np.array([[[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]] for a in angles])
    return Rotation.create_group(group).as_matrix()


def _orbit(group: str, motif: np.ndarray) -> np.ndarray:
    return np.einsum("gij,pj->gpi", _turns(group), motif).reshape(-1, motif.shape[1])


def symmetric(group: str, n_points: int, noise: float) -> Draft:
    """Return a cloud and a disturbed one that both have all symmetries of a point group."""
    order, dim = len(_turns(group)), 2 if group.startswith("2D") else 3
    name = f"symmetric-{group.removeprefix('2D')}{'-2d' if dim == 2 else ''}-{n_points}"
    name = f"{name}-{round(1000 * noise):03d}".lower()
    rng = _rng(name)
    motif = rng.standard_normal((n_points // order, dim))
    motif *= (0.3 + 0.2 * rng.random((len(motif), 1))) / np.linalg.norm(motif, axis=1)[:, None]
    changed = motif + noise * rng.standard_normal(motif.shape)
    source, target = _orbit(group, motif), _orbit(group, changed)
    turns = f"{order} turns" if dim == 2 else f"the {order} rotations of group {group}"
    return moved(
        name, "symmetry", f"Both clouds are invariant to {turns}; noise {noise:g}",
        source, target, _same(len(source)), planted_optima=order,
    )  # fmt: skip


SOLIDS = {
    "cube": ("O", (1.0, 1.0, 1.0)),
    "octahedron": ("O", (1.0, 0.0, 0.0)),
    "cuboctahedron": ("O", (1.0, 1.0, 0.0)),
    "icosahedron": ("I", (0.0, 1.0, (1 + 5**0.5) / 2)),
    "dodecahedron": ("I", (1.0, 1.0, 1.0)),
    "icosidodecahedron": ("I", (0.0, 0.0, 1.0)),
}


def solid(name: str, growth: float) -> Draft:
    """Return the vertices of a solid and of the same solid of a larger size."""
    group, corner = SOLIDS[name]
    every = _orbit(group, np.array([corner]) / np.linalg.norm(corner) / 2)
    vertices = every[np.sort(np.unique(every.round(9), axis=0, return_index=True)[1])]
    return moved(
        f"solid-{name}-{round(1000 * growth):03d}", "symmetry",
        f"Vertices of the {name}; the target is larger by {growth:.1%}",
        vertices, (1 + growth) * vertices, _same(len(vertices)),
        planted_optima=len(_turns(group)),
    )  # fmt: skip


def polygon(corners: int, growth: float) -> Draft:
    """Return a regular polygon and a larger one, at a fixed scale."""
    vertices = _orbit(f"2D{corners}", np.array([[0.5, 0.0]]))
    return moved(
        f"polygon-{corners}-{round(1000 * growth):03d}", "symmetry",
        f"Regular polygon with {corners} vertices; the target is larger by {growth:.1%}",
        vertices, (1 + growth) * vertices, _same(corners),
        planted_optima=corners, is_scaled=False,
    )  # fmt: skip


def mirrored(count: int, noise: float, dim: int) -> Draft:
    """Return a cloud that equals its mirror image, and a noisy one: the mirror trap of norms."""
    name = f"mirror-{dim}d-{count}-{round(1000 * noise):03d}"
    rng = _rng(name)
    half = rng.random((count // 2, dim)) - 0.5
    half[:, 0] = 0.05 + np.abs(half[:, 0])
    source = normalise(np.vstack([half, half * np.r_[-1.0, np.ones(dim - 1)]]))
    target = source + noise * rng.standard_normal(source.shape)
    title = f"The source is its own mirror image; noise {noise:g}"
    return moved(name, "symmetry", title, source, target, _same(len(source)))


# --- repetition --------------------------------------------------------------------------------


def lattice(side: int, dim: int, shared: int, jitter: float) -> Draft:
    """Return two patches of a lattice that share `shared` columns; each shift is nearly as good."""
    name = f"lattice-{dim}d-{side}-{shared}-{round(1000 * jitter):03d}"
    rng = _rng(name)
    grid = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), -1).reshape(-1, dim)
    at = grid / (side - 1.0)
    offsets = jitter * rng.standard_normal((2 * side - shared,) + (side,) * (dim - 1) + (dim,))
    far = grid + (side - shared) * np.eye(dim, dtype=int)[0]
    step = 1.0 / (side - 1.0)
    source = at + offsets[tuple(grid.T)]
    target = far * step + offsets[tuple(far.T)] + 0.3 * jitter * rng.standard_normal(at.shape)
    rows = np.flatnonzero(grid[:, 0] >= side - shared)
    columns = np.flatnonzero(grid[:, 0] < shared)
    title = f"Two patches of a jittered lattice share {shared} of {side} layers"
    return moved(
        name, "repetition", title, source, target, np.column_stack([rows, columns]),
        is_scaled=False,
    )  # fmt: skip


def helix(count: int, skipped: int, noise: float) -> Draft:
    """Return two parts of a helix; each shift along it is nearly as good."""
    name = f"helix-{count}-{skipped}-{round(1000 * noise):03d}"
    rng = _rng(name)
    step = np.arange(count + skipped)
    every = np.column_stack([np.cos(0.6 * step), np.sin(0.6 * step), 0.07 * step]) * 0.3
    every += 2 * noise * rng.standard_normal(every.shape)
    source, target = every[:count], every[skipped:]
    target = target + noise * rng.standard_normal(target.shape)
    rows = np.arange(skipped, count)
    title = f"Two parts of a helix, displaced by {skipped} of {count} points"
    return moved(name, "repetition", title, source, target, np.column_stack([rows, rows - skipped]))


def fence(count: int, skipped: int, noise: float) -> Draft:
    """Return two parts of a row of equal posts in 2D."""
    name = f"fence-{count}-{skipped}-{round(1000 * noise):03d}"
    rng = _rng(name)
    post = np.array([[0.0, 0.0], [0.0, 0.5], [0.02, 0.8]])
    posts = count // 3 + skipped
    every = (post + np.arange(posts)[:, None, None] * np.array([0.25, 0.0])).reshape(-1, 2)
    every += 2 * noise * rng.standard_normal(every.shape)
    source, target = every[: 3 * (posts - skipped)], every[3 * skipped :]
    target = target + noise * rng.standard_normal(target.shape)
    rows = np.arange(3 * skipped, len(source))
    title = f"Two parts of a fence with {posts - skipped} equal posts, displaced by {skipped}"
    return moved(
        name, "repetition", title, source, target,
        np.column_stack([rows, rows - 3 * skipped]), is_scaled=False,
    )  # fmt: skip


# --- near-ties and decoys ----------------------------------------------------------------------


def copies(shape: str, count: int, noises: tuple[float, float], family: str) -> Draft:
    """Return a target with two disturbed copies of the source; the first is the true one."""
    true, other = (round(1000 * noise) for noise in noises)
    name = f"{family}-{shape}-{count}-{true:03d}-{other:03d}"
    rng = _rng(name)
    source = _shape(shape, count)
    dim = source.shape[1]
    turn = np.eye(dim)
    turn[:2, :2] = [[-0.6, -0.8], [0.8, -0.6]]
    first, second = (source + noise * rng.standard_normal(source.shape) for noise in noises)
    target = np.vstack([first, second @ turn.T + 0.9 * np.eye(dim)[1]])
    what = "The false copy fits better" if other < true else "A false copy fits almost as well"
    title = f"{what}: noise {noises[0]:g} in the true copy, {noises[1]:g} in the other"
    return moved(name, family, title, source, target, _same(count), is_scaled=False)


def clutter(shape: str, count: int, extra: int, noise: float) -> Draft:
    """Return a noisy copy in clutter so dense that other poses fit better than the true one."""
    name = f"clutter-{shape}-{count}-{extra}-{round(1000 * noise):03d}"
    rng = _rng(name)
    source = _shape(shape, count)
    copy = source + noise * rng.standard_normal(source.shape)
    target = np.vstack([copy, rng.uniform(-0.7, 0.7, (extra, source.shape[1]))])
    title = f"A copy with noise {noise:g} among {extra} uniform points"
    return moved(name, "decoy", title, source, target, _same(count), is_scaled=False)


def overlap(shape: str, count: int, share: float) -> Draft:
    """Return two parts of a shape, cut by planes, that share a small part of their points."""
    name = f"overlap-{shape}-{count}-{round(100 * share):02d}"
    rng = _rng(name)
    every = _shape(shape, round(count * (2 - share)))
    changed = warp(every, 0.01, rng)
    order = np.argsort(every @ rng.standard_normal(every.shape[1]), kind="stable")
    in_source, in_target = np.sort(order[:count]), np.sort(order[-count:])
    _, rows, columns = np.intersect1d(in_source, in_target, return_indices=True)
    title = f"Two parts that share {share:.0%} of their points, deformed by 0.01"
    return moved(
        name, "overlap", title, every[in_source], changed[in_target],
        np.column_stack([rows, columns]), is_scaled=False,
    )  # fmt: skip


# --- tiny problems -----------------------------------------------------------------------------


def tiny(number: int) -> Draft:
    """Return a problem so small that all matchings can be tried."""
    dim, kind = 2 + number % 2, TINY_KINDS[number // 2 % 4]
    name = f"tiny-{dim}d-{kind}-{number // 8 + 1}"
    rng = _rng(name)
    n, m = (int(count) for count in rng.integers(4, 7, size=2))
    common = min(n, m)
    source = rng.random((n, dim)) - 0.5
    if kind == "line":
        source = np.outer(np.linspace(-0.5, 0.5, n), np.eye(dim)[0]) + 0.02 * source
    if kind == "regular":
        source[:, :2] = _orbit(f"2D{n}", np.array([[0.5, 0.0]]))
        source[:, 2:] = 0.0
    target = rng.random((m, dim)) - 0.5
    if kind != "random":
        target[:common] = source[:common] + 0.03 * rng.standard_normal((common, dim))
    k = max(3, common - int(rng.integers(2)))
    title = f"{n} and {m} points, {kind}; all matchings can be tried"
    return moved(name, "tiny", title, source, target, _same(k), is_scaled=bool(rng.integers(2)))


def constructed() -> Iterator[Draft]:
    """Yield all constructed problems, easy families first."""
    for number in range(36):
        yield tiny(number)
    for name in SOLIDS:
        yield solid(name, 0.1)
    for corners in (7, 12, 24, 60):
        yield polygon(corners, 0.1)
    for group, n_points in (("2D3", 60), ("2D6", 60), ("2D12", 60), ("2D5", 100)):
        for noise in (0.01, 0.05):
            yield symmetric(group, n_points, noise)
    for group, n_points in (("C2", 60), ("C5", 60), ("D3", 60), ("T", 60), ("O", 72), ("I", 60)):
        for noise in (0.01, 0.03):
            yield symmetric(group, n_points, noise)
    for dim in (2, 3):
        for noise in (0.005, 0.02):
            yield mirrored(60, noise, dim)
    for side, dim, shared in ((6, 2, 5), (8, 2, 6), (8, 2, 4), (3, 3, 2), (4, 3, 3)):
        for jitter in (0.01, 0.03):
            yield lattice(side, dim, shared, jitter)
    for count, skipped in ((30, 3), (60, 5)):
        for noise in (0.005, 0.01):
            yield helix(count, skipped, noise)
    for count, skipped in ((30, 2), (60, 3)):
        for noise in (0.005, 0.01):
            yield fence(count, skipped, noise)
    for shape, count in (("fish", 60), ("glyph", 40), ("pony", 60), ("saurian", 40)):
        yield copies(shape, count, (0.01, 0.0102), "near-tie")
        yield copies(shape, count, (0.02, 0.021), "near-tie")
        yield copies(shape, count, (0.03, 0.01), "decoy")
        yield clutter(shape, 30, 90, 0.03)
        yield overlap(shape, 60, 0.6)
        yield overlap(shape, 60, 0.3)
        yield overlap(shape, 60, 0.15)
