"""Quadratic functions over the box [-1, 1]^d, relaxed to a semidefinite programme of order d + 1.

Y represents s^2 (1, z) (1, z)^T with z in the box and some s in (0, 1]. The relaxed Y is positive
semidefinite and satisfies the products of the linear inequalities of the box,

    Y_00 - Y_ii >= 0,   Y_00 +- Y_0i +- Y_0j +- Y_ij >= 0   (signs of (1 +- z_i) (1 +- z_j)),

one normalisation <N, Y> = 1, and trace Y <= d + 1, which follows from the first rows and s <= 1. For any
mu >= 0 and any lambda every such Y has

    <C, Y> >= lambda + (d + 1) min(0, minimum eigenvalue of C - sum_k mu_k A_k - lambda N).

The solver only proposes mu and lambda, so its tolerances cannot invalidate the bound.
"""

from __future__ import annotations

import itertools

import clarabel
import numpy as np
from scipy import sparse

_SQRT2 = np.sqrt(2.0)


class LiftedBox:
    """The programme for one dimension. Its structure is set up once, its coefficients per box.

    Parameters
    ----------
    dim : int
        d, the number of coordinates z.
    """

    def __init__(self, dim: int) -> None:
        self.order = dim + 1
        # Clarabel's order of a triangle: by columns, off-diagonal entries times sqrt 2
        self._columns, self._rows = np.tril_indices(self.order)
        self._weights = np.where(self._rows == self._columns, 1.0, _SQRT2)
        self._first = np.flatnonzero(self._rows == 0)  # Y_00, Y_01, ...
        self._size = len(self._rows)
        self.products = np.array(_box_products(dim))
        cuts = np.array([self._vector(A) for A in self.products])
        stacked = np.vstack([np.ones((1, self._size)), -cuts, -np.eye(self._size)])
        self._matrix = sparse.csc_matrix(stacked)
        self._normalising = np.flatnonzero(self._matrix.indices == 0)
        self._right = np.zeros(len(stacked))
        self._right[0] = 1.0
        cones = [
            clarabel.ZeroConeT(1),
            clarabel.NonnegativeConeT(len(cuts)),
            clarabel.PSDTriangleConeT(self.order),
        ]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.presolve_enable = False
        settings.chordal_decomposition_enable = False
        self._solver = clarabel.DefaultSolver(
            sparse.csc_matrix((self._size, self._size)),
            np.ones(self._size),
            self._matrix,
            self._right,
            cones,
            settings,
        )

    def minimum(self, C: np.ndarray, N: np.ndarray) -> tuple[float, np.ndarray]:
        """Return a lower bound of <C, Y> subject to <N, Y> = 1, and the z of the solver's Y."""
        scale = float(np.abs(C).max()) or 1.0
        data = self._matrix.data
        data[self._normalising] = self._vector(N)
        self._solver.update(q=self._vector(C) / scale, A=data)
        solution = self._solver.solve()
        duals = scale * np.nan_to_num(np.array(solution.z))
        mu = np.maximum(duals[1 : 1 + len(self.products)], 0.0)
        slack = C - np.tensordot(mu, self.products, axes=1)
        value = float(-duals[0])
        value += self.order * min(0.0, float(np.linalg.eigvalsh(slack - value * N)[0]))
        first = np.array(solution.x)[self._first] / self._weights[self._first]
        z = first[1:] / first[0] if first[0] > 0.0 else np.zeros(self.order - 1)
        return value, np.nan_to_num(z)

    def _vector(self, C: np.ndarray) -> np.ndarray:
        return C[self._rows, self._columns] * self._weights


def _box_products(dim: int) -> list[np.ndarray]:
    """Return symmetric A with <A, Y> >= 0 for every product of two inequalities of the box."""
    matrices = []
    for i in range(1, dim + 1):
        A = np.zeros((dim + 1, dim + 1))
        A[0, 0], A[i, i] = 1.0, -1.0
        matrices.append(A)
    for i, j in itertools.combinations(range(1, dim + 1), 2):
        for p, q in itertools.product((1.0, -1.0), repeat=2):
            A = np.zeros((dim + 1, dim + 1))
            A[0, 0] = 1.0
            A[0, i] = A[i, 0] = 0.5 * p
            A[0, j] = A[j, 0] = 0.5 * q
            A[i, j] = A[j, i] = 0.5 * p * q
            matrices.append(A)
    return matrices
