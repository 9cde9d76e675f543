"""The annexed polytope: a fan of simplicial cones about an inner point that grows by vertices."""

from __future__ import annotations

import numpy as np

_VISIBLE = 1e-9  # a vertex must exceed a facet by more than this share to replace it
_WELL_SOLVED = 0.99  # minimum ``normal . vertex`` of a well-conditioned facet


class Polytope:
    """Facets ``normal . x <= 1`` about the origin, each with as many vertices as dimensions.

    The cones of the facets always cover the space. A new vertex replaces the facets that it exceeds by
    its joins with their common border, modulo 2. This does not change how often (modulo 2) a direction is
    covered, since no simplex between the vertex and such a facet contains the origin.

    Attributes
    ----------
    vertices : (N, r) array
    members : (C, r) int array
        Vertices of every facet, ascending; rows beyond `n_slots` are unused.
    normals : (C, r) array
    bounds : (C,) array
        Lower bound of the function over the cone of each facet; inf for replaced facets.
    passage : (C,) array
        By how much D exceeds the facet, ``max normal . x``: inf if not yet tested, 0 if the facet was
        replaced or cannot be exceeded.
    farthest : (C, r) array
        The point of D that attains the passage.
    """

    def __init__(self, vertices: np.ndarray, bound: float) -> None:
        count, dim = vertices.shape
        self.vertices = vertices
        self.n_slots = self.n_facets = 0
        self.members = np.empty((64, dim), np.int32)
        self.normals = np.empty((64, dim))
        self.bounds = np.full(64, np.inf)
        self.passage = np.zeros(64)
        self.farthest = np.empty((64, dim))
        everyone = np.arange(count, dtype=np.int32)
        members = np.array([np.delete(everyone, left_out) for left_out in everyone])
        normals = self._normals(members, vertices)
        if normals is None:
            raise np.linalg.LinAlgError("the first simplex is flat")
        self._add(members, normals, bound)

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.members, self.normals, self.bounds, self.passage, self.farthest

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self._arrays)

    @property
    def lower_bound(self) -> float:
        return float(self.bounds[: self.n_slots].min())

    def untested(self, count: int) -> np.ndarray:
        """Return up to `count` untested facets, lowest bounds first."""
        facets = np.flatnonzero(np.isinf(self.passage[: self.n_slots]))
        if len(facets) > count:
            facets = facets[np.argsort(self.bounds[facets], kind="stable")[:count]]
        return facets

    def most_passed(self) -> int:
        """Return the tested facet that D exceeds most, the oldest of equals."""
        passage = self.passage[: self.n_slots]
        return int(np.argmax(np.where(np.isinf(passage), 0.0, passage)))

    def annex(self, vertex: np.ndarray) -> bool:
        """Add a vertex; return False if it exceeds no facet or its facets would be degenerate."""
        passed = self.normals[: self.n_slots] @ vertex > 1.0 + _VISIBLE
        passed &= np.isfinite(self.bounds[: self.n_slots])
        replaced = np.flatnonzero(passed)
        if not replaced.size:
            return False
        vertices = np.vstack([self.vertices, vertex])
        ridges = self._border(self.members[replaced])
        fresh = np.full((len(ridges), 1), len(self.vertices), np.int32)
        members = np.hstack([ridges, fresh])
        normals = self._normals(members, vertices)
        if normals is None:
            return False
        inherited = float(self.bounds[replaced].min())
        self.vertices = vertices
        self.bounds[replaced] = np.inf
        self.passage[replaced] = 0.0
        self.n_facets -= len(replaced)
        self._compact(len(members))
        self._add(members, normals, inherited)
        return True

    @staticmethod
    def _border(members: np.ndarray) -> np.ndarray:
        """Return the faces of one dimension less that belong to an odd number of the facets."""
        dim = members.shape[1]
        if dim == 1:  # the empty face of a single point
            return np.empty((len(members) % 2, 0), np.int32)
        faces = np.concatenate([np.delete(members, left_out, axis=1) for left_out in range(dim)])
        order = np.lexsort(faces.T)
        faces = faces[order]
        first = np.append(True, (faces[1:] != faces[:-1]).any(axis=1))
        starts = np.flatnonzero(first)
        counts = np.diff(np.append(starts, len(faces)))
        return faces[starts[counts % 2 == 1]]

    @staticmethod
    def _normals(members: np.ndarray, vertices: np.ndarray) -> np.ndarray | None:
        corners = vertices[members]
        try:
            normals = np.linalg.solve(corners, np.ones((*members.shape, 1)))[..., 0]
        except np.linalg.LinAlgError:
            return None
        reached = np.einsum("fvc,fc->fv", corners, normals)
        return normals if (np.abs(reached - 1.0) < 1.0 - _WELL_SOLVED).all() else None

    def _add(self, members: np.ndarray, normals: np.ndarray, bound: float) -> None:
        new = slice(self.n_slots, self.n_slots + len(members))
        while new.stop > len(self.members):
            self._grow()
        self.members[new], self.normals[new] = members, normals
        self.bounds[new], self.passage[new] = bound, np.inf
        self.n_slots = new.stop
        self.n_facets += len(members)

    def _grow(self) -> None:
        more = len(self.members)
        self.members = np.concatenate([self.members, np.empty_like(self.members)])
        self.normals = np.concatenate([self.normals, np.empty_like(self.normals)])
        self.bounds = np.concatenate([self.bounds, np.full(more, np.inf)])
        self.passage = np.concatenate([self.passage, np.zeros(more)])
        self.farthest = np.concatenate([self.farthest, np.empty_like(self.farthest)])

    def _compact(self, coming: int) -> None:
        """Remove replaced facets before the arrays grow."""
        if self.n_slots + coming <= len(self.members) or self.n_facets > 0.7 * self.n_slots:
            return
        alive = np.flatnonzero(np.isfinite(self.bounds[: self.n_slots]))
        for array in self._arrays:
            array[: len(alive)] = array[alive]
        self.bounds[len(alive) :] = np.inf
        self.passage[len(alive) :] = 0.0
        self.n_slots = len(alive)
