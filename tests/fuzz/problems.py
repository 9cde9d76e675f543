"""Random small problems, among them the awkward ones, each made by its number alone."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.families.rigid3d import cover as triples
from dcreg.families.similarity2d import cover as distances
from dcreg.names import BOUND_NAMES
from dcreg.result import Result
from dcreg.search import space_search
from tests.problems import keywords

KINDS = ("general", "copy", "duplicates", "collinear", "grid", "symmetric", "clutter")
# Shares of the families, and weights of the bounds within one: the default bound is drawn most often.
FAMILIES = {"similarity2d": 0.58, "norm3d": 0.3, "rigid3d": 0.12}
MODES = {"similarity2d": "paper", "norm3d": "paper", "rigid3d": "full"}
EMPHASIS = {"tight": 8.0, "shared": 4.0, "dc": 2.0}
# No problem may take long; one that ends at a limit still has bounds to be checked.
NODE_LIMIT, TIME_LIMIT = 2000, 5.0
RIGID_LIMIT = 10_000


@dataclass(frozen=True)
class FuzzProblem:
    """One problem with the settings to solve it."""

    number: int
    family: str  # a key of FAMILIES
    kind: str
    source: np.ndarray
    target: np.ndarray
    n_inliers: int
    allowed: np.ndarray  # (n, m) bool: which pairs may be matched
    settings: dict[str, Any]

    @property
    def scale_range(self) -> tuple[float, float]:
        return self.settings.get("scale_range", (1.0, 1.0))

    @property
    def has_cover(self) -> bool:
        """Whether a cover confines the search, which only larger problems need."""
        return self.family != "norm3d" and self.number % 2 == 0

    def solve(self) -> Result:
        certificate = not self.has_cover  # the leaf boxes of a search with a cover are no partition
        with covered() if self.has_cover else contextlib.nullcontext():
            return dcreg.register(
                self.source,
                self.target,
                n_inliers=self.n_inliers,
                time_limit=TIME_LIMIT,
                candidates=None if self.allowed.all() else self.allowed,
                **keywords(**self.settings, certificate=certificate),
            )

    def __str__(self) -> str:
        shown = {k: v for k, v in self.settings.items() if k != "model"}
        return (
            f"#{self.number} {self.family} {self.kind} {len(self.source)}x{len(self.target)} "
            f"k={self.n_inliers} {int(self.allowed.sum())} pairs {shown}"
        )


@contextlib.contextmanager
def covered() -> Iterator[None]:
    """A context in which the search begins with a cover, however small the problem is."""
    with contextlib.ExitStack() as patches:
        patches.enter_context(mock.patch.object(space_search, "SHORT", 0))
        for cover in triples, distances:
            patches.enter_context(mock.patch.object(cover, "FEW_PAIRS", 0))
        yield


def problem(number: int, family: str | None = None) -> FuzzProblem:
    """Problem `number`, always the same one."""
    rng = np.random.default_rng([20260326, number])
    drawn = str(rng.choice(list(FAMILIES), p=list(FAMILIES.values())))
    family = family or drawn
    dim = 2 if family == "similarity2d" else 3
    n, m = (int(size) for size in rng.integers(2, 7 if family == "rigid3d" else 8, 2))
    kind = str(rng.choice(KINDS))
    source, target = _clouds(rng, kind, n, m, dim)
    n_inliers = int(rng.integers(1, min(n, m) + 1))
    settings = _settings(rng, family, target, n_inliers)
    if number % 3 == 0:  # the default tolerances
        del settings["rel_gap"], settings["abs_gap"]
    allowed = np.ones((n, m), dtype=bool)
    if rng.random() < 0.15:
        allowed = rng.random((n, m)) < 0.6
        # some matching of n_inliers pairs has to be among them
        allowed[rng.permutation(n)[:n_inliers], rng.permutation(m)[:n_inliers]] = True
    return FuzzProblem(number, family, kind, source, target, n_inliers, allowed, settings)


def _settings(
    rng: np.random.Generator, family: str, target: np.ndarray, n_inliers: int
) -> dict[str, Any]:
    extent = float(np.sqrt(((target - target.mean(axis=0)) ** 2).sum(axis=1).mean()))
    tau = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    settings = {
        "model": "similarity2d" if family == "similarity2d" else "rigid3d",
        "mode": MODES[family],
        "rel_gap": 0.0,
        "abs_gap": n_inliers * (tau * (extent or 1.0)) ** 2,
        "start_box": str(rng.choice(["stationary", "radius"])),
        "polish": bool(rng.random() < 0.2),
        "node_limit": NODE_LIMIT,
    }
    if family == "rigid3d":  # has bounds of its own
        return settings | {"node_limit": RIGID_LIMIT}
    names = list(BOUND_NAMES)
    weights = np.array([EMPHASIS.get(name, 0.5) for name in names])
    bound = str(rng.choice(names, p=weights / weights.sum()))
    settings["bound"] = f"{bound}+interval" if rng.random() < 0.1 and bound != "interval" else bound
    if family == "similarity2d":
        low = float(rng.choice([0.3, 0.5, 0.9, 1.0]))
        settings["scale_range"] = (low, low * float(rng.choice([1.0, 1.2, 3.0])))
    return settings


def _clouds(
    rng: np.random.Generator, kind: str, n: int, m: int, dim: int
) -> tuple[np.ndarray, np.ndarray]:
    source, target = rng.standard_normal((n, dim)), rng.standard_normal((m, dim))
    both = min(n, m)
    if kind in ("copy", "symmetric", "clutter"):
        if kind == "symmetric":  # its own mirror image
            source[n // 2 : 2 * (n // 2)] = source[: n // 2] * ([-1.0] + [1.0] * (dim - 1))
        shared = max(1, both // 2) if kind == "clutter" else both
        noise = float(rng.choice([0.0, 0.03, 0.2]))
        target[:shared] = source[:shared] + noise * rng.standard_normal((shared, dim))
    elif kind == "duplicates":
        source[n // 2 :] = source[0]
        if rng.random() < 0.7:
            target[m // 2 :] = target[0]
    elif kind == "collinear":
        source = source[:, :1] * rng.standard_normal(dim)
        if rng.random() < 0.7:
            target = target[:, :1] * rng.standard_normal(dim)
    elif kind == "grid":  # many ties
        source, target = np.round(source), np.round(target)
    moved = (target @ _rotation(rng, dim).T) * float(rng.choice([1.0, 0.7]) if dim == 2 else 1.0)
    unit = float(rng.choice([1.0, 1.0, 1e-3, 1e3]))
    return unit * source, unit * (rng.permutation(moved) + rng.standard_normal(dim))


def _rotation(rng: np.random.Generator, dim: int) -> np.ndarray:
    if dim == 3:
        return Rotation.random(rng=rng).as_matrix()
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
