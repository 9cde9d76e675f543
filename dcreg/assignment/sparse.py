"""One-to-one matching of large clouds over nearest neighbours, with a proof of optimality if possible.

A dense cost matrix of 10,000 x 10,000 pairs takes 800 MB, and its assignment takes hours. At any good
pose, however, a point is matched with one of its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.assignment.kernels.duals import assignment_duals
from dcreg.assignment.kernels.sparse import greedy_matching, penalised_matching
from dcreg.jit import NEVER
from dcreg.problem.trees import Tree, tree_of

# Maximum number of pairs in a dense matrix, and of neighbour pairs in a sparse one.
DENSE_PAIRS = 4_000_000
_FIRST_NEIGHBOURS = 16
_ROUGH_NEIGHBOURS = 8  # if no proof is requested, and not all rows need a partner
# If no time is left: so few neighbours, at most by this share farther than the nearest ones.
_GREEDY_NEIGHBOURS, _GREEDY_SLACK = 8, 0.5
_HUGE_GREEDY, _MANY_ROWS = 4, 100_000  # fewer neighbours for more rows than this
_LAST_NEIGHBOURS, _LAST_SLACK = 2, 1.0  # if the time ends during a query
_CELLS = 40  # along the longest side, by which many rows are ordered
_QUERY_ROWS = 20_000  # between two looks at the stop flag
_LEFTOVER_ROUNDS, _LAST_ROUNDS = 8, 2  # of pairing near points that are still unmatched
_SPARE = 3  # points looked at for each pair that is missing
_MAX_PENALTIES = 16  # of unmatched rows, tried in turn
# With fewer matched pairs, as a share of k, more neighbours take long and prove nothing.
_MIN_MATCHED_SHARE = 0.9
_ROUGH = 0.02  # relative error of the size of a matching that is cut or completed without a proof
_ROUGH_ROWS = 150_000  # rows of all assignments for which a rough penalty is sought


@dataclass(frozen=True)
class Matching:
    """k one-to-one pairs.

    Attributes
    ----------
    value : float
        Their sum of squared distances.
    pairs : (k, 2) int array
    exact : bool
        Whether it is proved optimal over all pairs; otherwise `value` is an upper bound.
    n_assignments : int
        Sparse assignments solved.
    """

    value: float
    pairs: np.ndarray
    exact: bool
    n_assignments: int


def sparse_matching(
    points: np.ndarray,
    target: np.ndarray,
    k: int,
    *,
    prove: bool = True,
    most: int = DENSE_PAIRS,
    stop: np.ndarray = NEVER,
) -> Matching:
    """Return the cheapest k one-to-one pairs by squared distance, without a dense matrix.

    The assignment is solved over each point's nearest neighbours, 16 at first. If the dual variables do
    not prove that farther pairs are useless, the number of neighbours is quadrupled, up to `most` pairs
    in total. If this does not suffice either, the best matching is returned as not exact. Points
    that remain unmatched are paired with near ones among themselves.

    Without `prove`, only the first neighbours are used (8, or 16 if k = n), and the penalty of an
    unmatched row is found approximately. This gives a near-optimal matching in a fraction of the time,
    for the steps of a descent. If `stop` is set during the call, near pairs are chosen greedily instead;
    if it is set before, from few neighbours.
    """
    if len(points) > len(target):
        found = sparse_matching(target, points, k, prove=prove, most=most, stop=stop)
        pairs = found.pairs[:, ::-1]
        return Matching(
            found.value, pairs[np.argsort(pairs[:, 0])], found.exact, found.n_assignments
        )
    n, m = len(points), len(target)
    tree = tree_of(target)
    first = _FIRST_NEIGHBOURS if prove or k == n else min(_ROUGH_NEIGHBOURS, _FIRST_NEIGHBOURS)
    neighbours, spent = min(first, m), 0
    best: Matching | None = None
    while True:
        columns, costs = _near(tree, points, neighbours, stop)
        solved = 0
        if not stop[0]:
            col_of, own, solved = _matching_of_size(columns, costs, m, k, prove, stop)
        if stop[0]:  # possibly set during the assignment
            col_of, own = _greedy(columns, costs, m, k), None
        spent += solved
        exact = (
            prove
            and own is not None
            and _is_proved(points, tree, columns, costs, col_of, own, stop)
        )
        value, pairs = _completed(points, target, col_of, k, costs[:, 0], stop)
        if best is None or exact or value < best.value:
            best = Matching(value, pairs, exact, spent)
        is_short = k < n and int((col_of >= 0).sum()) < _MIN_MATCHED_SHARE * k
        is_last = neighbours == m or 4 * neighbours * n > most
        if exact or not prove or stop[0] or is_last or is_short:
            return Matching(best.value, best.pairs, best.exact, spent)
        neighbours = min(4 * neighbours, m)


def _near(
    tree: Tree, points: np.ndarray, count: int, stop: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` near points of the tree for each row, nearest first, and their costs.

    Once `stop` is set, they are fewer and less near; missing ones have infinite costs.
    """
    slack = 0.0
    if stop[0]:
        few = _HUGE_GREEDY if len(points) > _MANY_ROWS else _GREEDY_NEIGHBOURS
        count, slack = min(count, few), _GREEDY_SLACK
    was_over = bool(stop[0])
    columns = np.zeros((len(points), count), np.int64)
    costs = np.full((len(points), count), np.inf)
    wanted, order = count, _by_place(points)
    for begin in range(0, len(points), _QUERY_ROWS):
        if stop[0] and not was_over:
            wanted, slack = min(count, _LAST_NEIGHBOURS), _LAST_SLACK
        rows = order[begin : begin + _QUERY_ROWS]
        some = points[rows]
        distances, columns[rows, :wanted] = tree.neighbours(some, wanted, slack=slack)
        costs[rows, :wanted] = distances**2
    return columns, costs


def _by_place(points: np.ndarray) -> np.ndarray:
    """Return an order of the rows in which, if they are many, nearby points follow each other.

    Consecutive queries then read the same part of the tree and take a third of the time.
    """
    if len(points) <= _MANY_ROWS:
        return np.arange(len(points))
    size = np.ptp(points, axis=0).max() / _CELLS or 1.0
    return np.lexsort((points // size).T)


def _matching_of_size(
    columns: np.ndarray, costs: np.ndarray, m: int, k: int, prove: bool, stop: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Return the columns of the cheapest k candidate pairs, the costs of rows, assignments solved.

    The costs of rows are None if there are fewer than k pairs, or if they are not certainly the cheapest.

    An unmatched row costs a penalty, a Lagrange multiplier. The number of matched rows grows with it. If
    the number is k, the matching is the cheapest of that size. The penalty is found by interpolation.
    """
    n = len(columns)
    top = 4.0 * n * (costs.max() or 1.0)  # exceeds any matching: as many rows as possible
    empty = _Partial.of(n, m)
    if k == n:
        col_of = empty.continued(columns, costs, top, stop).col_of
        complete = bool((col_of >= 0).all())
        return col_of, _own_costs(columns, costs, col_of, top) if complete else None, 1
    low, n_low, high, n_high = 0.0, 0, top, n + 1
    smaller = empty  # the matching for the penalty `low`
    penalty = 2.0 * float(np.partition(costs[:, 0], k - 1)[k - 1]) or 1e-9 * top
    enough = None
    most = _MAX_PENALTIES if prove else int(np.clip(_ROUGH_ROWS // k, 1, _MAX_PENALTIES))
    for solved in range(1, most + 1):
        found = smaller.continued(columns, costs, penalty, stop)
        col_of, size = found.col_of, found.size
        if size == k:
            return col_of, _own_costs(columns, costs, col_of, penalty), solved
        if size > k:
            high, n_high, enough = penalty, size, col_of
            if not prove and size <= (1.0 + _ROUGH) * k:
                break
        else:
            low, n_low, smaller = penalty, size, found
            if not prove and size >= (1.0 - _ROUGH) * k:
                return col_of, None, solved
        if enough is None:
            # if all candidates are used already, a higher penalty hardly adds a pair
            is_high = low > costs.max()
            if low == top or stop[0] or (not prove and is_high):
                break
            penalty = top if is_high else min(4.0 * penalty, top)
        else:
            share = np.clip((k - n_low) / (n_high - n_low), 0.05, 0.95)
            # the number of matched rows is nearly linear in the logarithm of the penalty
            penalty = low * (high / low) ** float(share) if low else float(share) * high
    if enough is None:
        return col_of, None, solved
    # ties, or the penalty would have to be too exact: keep the cheapest k pairs of a larger matching
    rows = np.flatnonzero(enough >= 0)
    kept = rows[np.argsort(_own_costs(columns, costs, enough, np.inf)[rows], kind="stable")[:k]]
    col_of = np.full(n, -1, np.int64)
    col_of[kept] = enough[kept]
    return col_of, None, solved


@dataclass(frozen=True)
class _Partial:
    """The cheapest matching for a penalty: columns of rows, rows of columns (-1: none), and duals."""

    col_of: np.ndarray
    row_of: np.ndarray
    u: np.ndarray
    v: np.ndarray

    @classmethod
    def of(cls, n: int, m: int) -> _Partial:
        """Return the matching without pairs, that for the penalty 0."""
        return cls(np.full(n, -1), np.full(m, -1), np.zeros(n), np.zeros(m))

    @property
    def size(self) -> int:
        return int((self.col_of >= 0).sum())

    def continued(
        self, columns: np.ndarray, costs: np.ndarray, penalty: float, stop: np.ndarray
    ) -> _Partial:
        """Return the cheapest matching for a larger penalty."""
        found = _Partial(self.col_of.copy(), self.row_of.copy(), self.u.copy(), self.v.copy())
        state = found.col_of, found.row_of, found.u, found.v
        penalised_matching(columns, costs, penalty, stop, *state)
        return found


def _greedy(columns: np.ndarray, costs: np.ndarray, m: int, k: int) -> np.ndarray:
    """Return each row's column (-1: none): pairs of free points are taken in order of distance."""
    n, width = columns.shape
    order = np.argsort(costs, axis=None, kind="stable")
    return greedy_matching(order // width, columns.ravel()[order], n, m, k)


def greedy_count(points: np.ndarray, tree: Tree, reach: float) -> int:
    """Return the number of one-to-one pairs with target points within `reach`, nearest first."""
    width = min(_GREEDY_NEIGHBOURS, tree.n)
    distances, columns = tree.neighbours(points, width, reach=float(np.nextafter(reach, np.inf)))
    rows, ranks = np.nonzero(distances <= reach)
    order = np.argsort(distances[rows, ranks], kind="stable")
    pairs = rows[order], columns[rows, ranks][order]
    return int((greedy_matching(*pairs, len(points), tree.n, len(points)) >= 0).sum())


def _own_costs(
    columns: np.ndarray, costs: np.ndarray, col_of: np.ndarray, penalty: float
) -> np.ndarray:
    chosen = columns == col_of[:, None]
    own = np.take_along_axis(costs, chosen.argmax(axis=1)[:, None], axis=1)[:, 0]
    return np.where(col_of >= 0, own, penalty)


def _is_proved(
    points: np.ndarray,
    tree: Tree,
    columns: np.ndarray,
    costs: np.ndarray,
    col_of: np.ndarray,
    own: np.ndarray,
    stop: np.ndarray,
) -> bool:
    """Tell whether no farther pair can improve the matching, by the dual variables."""
    u, v, converged = assignment_duals(columns, costs, col_of, own, tree.n)
    if not converged:
        return False
    neighbours = columns.shape[1]
    rows = np.flatnonzero(costs[:, -1] < u)
    while rows.size and neighbours < tree.n:
        neighbours = min(4 * neighbours, tree.n)
        if neighbours * rows.size > DENSE_PAIRS:
            return False
        farther, costs = _near(tree, points[rows], neighbours, stop)
        if stop[0] or (costs - u[rows, None] < v[farther] - 1e-12 * own.max()).any():
            return False
        rows = rows[costs[:, -1] < u[rows]]
    return True


def _completed(
    points: np.ndarray,
    target: np.ndarray,
    col_of: np.ndarray,
    k: int,
    nearest: np.ndarray,
    stop: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Return the value and exactly k pairs: those of `col_of`, completed by unmatched points.

    Unmatched points are paired with near unmatched ones in a few rounds (fewer if no time is left), those
    with the lowest cost `nearest` of their nearest point first. The rest is paired in the order along the
    longest side.
    """
    col_of = col_of.copy()
    for _ in range(_LAST_ROUNDS if stop[0] else _LEFTOVER_ROUNDS):
        missing = k - int((col_of >= 0).sum())
        if missing <= 0:
            break
        rows, columns = _left_over(col_of, len(target))
        rows = rows[np.argsort(nearest[rows], kind="stable")[: _SPARE * missing]]
        wanted = min(_FIRST_NEIGHBOURS, len(columns))
        at, costs = _near(Tree(target[columns]), points[rows], wanted, stop)
        chosen = _greedy(at, costs, len(columns), missing)
        col_of[rows] = np.where(chosen >= 0, columns[chosen], -1)
    missing = k - int((col_of >= 0).sum())
    if missing > 0:
        axis = int(np.argmax(np.ptp(target, axis=0)))
        rows, columns = _left_over(col_of, len(target))
        rows = rows[np.argsort(points[rows, axis], kind="stable")]
        columns = columns[np.argsort(target[columns, axis], kind="stable")]
        spread = np.linspace(0, len(columns) - 1, len(rows)).round().astype(int)
        col_of[rows[:missing]] = columns[spread][:missing]
    pairs = np.stack([np.flatnonzero(col_of >= 0), col_of[col_of >= 0]], axis=1)
    value = float(((points[pairs[:, 0]] - target[pairs[:, 1]]) ** 2).sum())
    return value, pairs.astype(np.int64)


def _left_over(col_of: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns that are in no pair."""
    free = np.ones(m, dtype=bool)
    free[col_of[col_of >= 0]] = False
    return np.flatnonzero(col_of < 0), np.flatnonzero(free)


def nearest_pairs(points: np.ndarray, tree: Tree, k: int) -> tuple[np.ndarray, float]:
    """Return the k points nearest to the target with their neighbours, and the sum of squares.

    The pairs are not one-to-one.
    """
    distances, columns = tree.nearest(points)
    rows = np.sort(np.argsort(distances, kind="stable")[:k])
    return np.stack([rows, columns[rows]], axis=1), float((distances[rows] ** 2).sum())
