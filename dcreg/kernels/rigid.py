"""Bounds over boxes of rigid poses, and the local descent between matching and pose.

A box has seven axes: four of a quaternion, three of the translation of y = R x + t. Point sets are
stored by component, (3, n) and (3, m). Where not every pair is feasible, n more rows follow in the
target: what pair (i, j) costs beyond its residual. Why the bounds hold is written in `dcreg.rigid`.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.assignment import dual_bound, k_assignment_duals
from dcreg.kernels.compiling import jit
from dcreg.kernels.rotation import best_rotation, rotation_matrix, sum_of_smallest

_MAX_ROUNDS = 100
_REFITS = 2
_SWEEPS = 30
_BIDS = 3
# A box this far below the cutoff is divided before dearer bounds are tried.
_WORTH_PAIRS = 0.2
_WORTH_ASSIGNMENT = 0.3


@jit
def relative_corners(centre, lower, upper, out):
    """Gibbs vectors from the rotation `centre` to the corners of a quaternion box.

    Fills rows of `out` (8, 3), returns their number; 0 where a corner lies a half-turn away or more.
    """
    count = 0
    a, b, c, d = centre[0], -centre[1], -centre[2], -centre[3]  # the inverse of the centre
    for v in range(16):
        flat = False
        for axis in range(4):
            flat |= (v >> axis) & 1 == 1 and upper[axis] <= lower[axis]
        if flat:  # the same corner as another one
            continue
        w = upper[0] if v & 1 else lower[0]
        x = upper[1] if v & 2 else lower[1]
        y = upper[2] if v & 4 else lower[2]
        z = upper[3] if v & 8 else lower[3]
        real = w * a - x * b - y * c - z * d
        if real <= 0.0:
            return 0
        out[count, 0] = (w * b + x * a + y * d - z * c) / real
        out[count, 1] = (w * c - x * d + y * a + z * b) / real
        out[count, 2] = (w * d + x * c - y * b + z * a) / real
        count += 1
    return count


@jit
def column_norms(points):
    return np.sqrt(points[0] ** 2 + points[1] ** 2 + points[2] ** 2)


@jit
def cap_costs(moved, reach, angle, shifted, out):
    """Least squared distance of every target to every source turned by at most `angle`: (m, n)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    for j in range(shifted.shape[1]):
        u, v, w = shifted[0, j], shifted[1, j], shifted[2, j]
        other = u * u + v * v + w * w
        length = math.sqrt(other)
        row = out[j]
        for i in range(moved.shape[1]):
            full = reach[i] * length
            dot = moved[0, i] * u + moved[1, i] * v + moved[2, i] * w
            turned = dot * cosine + math.sqrt(max(0.0, full * full - dot * dot)) * sine
            best = full if dot >= full * cosine else turned
            row[i] = reach[i] * reach[i] + other - 2.0 * best
    if shifted.shape[0] > 3:
        out += shifted[3:].T


@jit
def nearest_bound(caps, slack, k):
    """Sum of the k smallest squares of (nearest cap distance - slack)."""
    low = caps[0].copy()
    for j in range(1, caps.shape[0]):
        row = caps[j]
        for i in range(low.size):
            low[i] = row[i] if row[i] < low[i] else low[i]
    for i in range(low.size):
        low[i] = max(0.0, math.sqrt(max(0.0, low[i])) - slack) ** 2
    return sum_of_smallest(low, k)


@jit
def pair_costs(moved, reach, angle, shifted, half, out):
    """(n, m) least squared residuals of the pairs over the box, each pair on its own.

    Two bounds compete: the cap widened by the half-diagonal of the translations, and the box of
    translations widened by the longest chord of the rotations.
    """
    slack = math.sqrt((half**2).sum())
    chord = 2.0 * math.sin(0.5 * angle)
    cosine, sine = math.cos(angle), math.sin(angle)
    lengths = column_norms(shifted)
    us, vs, ws = shifted[0], shifted[1], shifted[2]
    h0, h1, h2 = half[0], half[1], half[2]
    for i in range(out.shape[0]):
        x, y, z, own = moved[0, i], moved[1, i], moved[2, i], reach[i]
        widen = chord * own
        row = out[i]
        for j in range(row.size):
            u, v, w, length = us[j], vs[j], ws[j], lengths[j]
            full = own * length
            dot = x * u + y * v + z * w
            turned = dot * cosine + math.sqrt(max(0.0, full * full - dot * dot)) * sine
            best = full if dot >= full * cosine else turned
            capped = math.sqrt(max(0.0, own * own + length * length - 2.0 * best)) - slack
            a = max(0.0, abs(x - u) - h0)
            b = max(0.0, abs(y - v) - h1)
            c = max(0.0, abs(z - w) - h2)
            boxed = math.sqrt(a * a + b * b + c * c) - widen
            short = max(0.0, max(capped, boxed))
            row[j] = short * short
    if shifted.shape[0] > 3:
        out += shifted[3:]


@jit
def bid(cost, k, b):
    """Raise duals `b` >= 0 by bids of the k rows that start cheapest: a rough auction.

    Whatever it ends at, `dual_bound` of the result is a valid bound. Costs about two passes over
    the pairs; an assignment costs dozens.
    """
    n, m = cost.shape
    low = np.empty(n)
    for i in range(n):
        value = np.inf
        for j in range(m):
            value = min(value, cost[i, j] + b[j])
        low[i] = value
    queue = np.argsort(low)[:k].copy()
    owner = np.full(m, -1, np.int64)
    head, size, budget = 0, k, _BIDS * k
    while size > 0 and budget > 0:
        i = queue[head]
        head = (head + 1) % k
        size -= 1
        budget -= 1
        first, second, at = np.inf, np.inf, -1
        row = cost[i]
        for j in range(m):
            value = row[j] + b[j]
            if value < second:
                if value < first:
                    second, first, at = first, value, j
                else:
                    second = value
        loser = owner[at]
        owner[at] = i
        if (loser >= 0 or b[at] > 0.0) and second < np.inf:
            b[at] += second - first
        if loser >= 0:
            queue[(head + size) % k] = loser
            size += 1


@jit
def residuals(moved, shifted, delta, terms):
    """Terms of every pair at delta = (r, s): |e|^2, 2e and 2 m x e, as (7, m, n).

    e = x - y + s + r x m with m = x + y: the residual that bounds the true one from below. What a
    pair costs beyond it is added to |e|^2.
    """
    r0, r1, r2, s0, s1, s2 = delta[0], delta[1], delta[2], delta[3], delta[4], delta[5]
    for j in range(shifted.shape[1]):
        u, v, w = shifted[0, j], shifted[1, j], shifted[2, j]
        for i in range(moved.shape[1]):
            x, y, z = moved[0, i], moved[1, i], moved[2, i]
            a, b, c = x + u, y + v, z + w
            e = x - u + s0 + r1 * c - r2 * b
            f = y - v + s1 + r2 * a - r0 * c
            g = z - w + s2 + r0 * b - r1 * a
            terms[0, j, i] = e * e + f * f + g * g
            terms[1, j, i] = 2.0 * (b * g - c * f)
            terms[2, j, i] = 2.0 * (c * e - a * g)
            terms[3, j, i] = 2.0 * (a * f - b * e)
            terms[4, j, i] = 2.0 * e
            terms[5, j, i] = 2.0 * f
            terms[6, j, i] = 2.0 * g
    if shifted.shape[0] > 3:
        terms[0] += shifted[3:].T


@jit
def fit_delta(moved, shifted, col_of, lower, upper, delta):
    """Best (r, s) in a box for given pairs: bounded least squares by coordinate descent."""
    H = np.zeros((6, 6))
    g = np.zeros(6)
    for i in range(col_of.size):
        j = col_of[i]
        if j < 0:
            continue
        a = moved[0, i] + shifted[0, j]
        b = moved[1, i] + shifted[1, j]
        c = moved[2, i] + shifted[2, j]
        e = moved[0, i] - shifted[0, j]
        f = moved[1, i] - shifted[1, j]
        h = moved[2, i] - shifted[2, j]
        H[0, 0] += b * b + c * c
        H[1, 1] += a * a + c * c
        H[2, 2] += a * a + b * b
        H[0, 1] -= a * b
        H[0, 2] -= a * c
        H[1, 2] -= b * c
        # rows of r against s: m x (.) applied to the residual's shift
        H[0, 4] -= c
        H[0, 5] += b
        H[1, 3] += c
        H[1, 5] -= a
        H[2, 3] -= b
        H[2, 4] += a
        g[0] += b * h - c * f
        g[1] += c * e - a * h
        g[2] += a * f - b * e
        g[3] += e
        g[4] += f
        g[5] += h
        for d in range(3, 6):
            H[d, d] += 1.0
    for p in range(6):
        for q in range(p):
            H[p, q] = H[q, p]
    for p in range(6):
        delta[p] = min(max(0.0, lower[p]), upper[p])
    for _ in range(_SWEEPS):
        for p in range(6):
            if H[p, p] > 0.0:
                slope = g[p]
                for q in range(6):
                    slope += H[p, q] * delta[q]
                delta[p] = min(max(delta[p] - slope / H[p, p], lower[p]), upper[p])


@jit
def linear_costs(terms, step):
    """(n, m) linearised costs of all pairs a `step` away from where `terms` were taken."""
    _, m, n = terms.shape
    out = np.empty((n, m))
    for j in range(m):
        for i in range(n):
            value = terms[0, j, i]
            for p in range(6):
                value += step[p] * terms[p + 1, j, i]
            out[i, j] = value
    return out


@jit
def dual_bound_at(terms, step, k, b, low):
    """`dual_bound` of `linear_costs` without forming the matrix."""
    _, m, n = terms.shape
    p, q, r, u, v, w = step[0], step[1], step[2], step[3], step[4], step[5]
    for i in range(n):
        low[i] = np.inf
    for j in range(m):
        t0, t1, t2, t3 = terms[0, j], terms[1, j], terms[2, j], terms[3, j]
        t4, t5, t6 = terms[4, j], terms[5, j], terms[6, j]
        own = b[j]
        for i in range(n):
            cost = (
                own + t0[i] + p * t1[i] + q * t2[i] + r * t3[i] + u * t4[i] + v * t5[i] + w * t6[i]
            )
            low[i] = cost if cost < low[i] else low[i]
    return sum_of_smallest(low, k) - b.sum()


@jit
def vertex_bound(moved, shifted, corners, half, k, floor, cutoff, col_of):
    """The linearised vertex bound as far as it decides, and the assignments solved.

    `col_of` is a good matching at the centre. -inf once a first pass shows that the bound will not
    exceed `floor`.
    """
    n, m = moved.shape[1], shifted.shape[1]
    low_box, high_box = np.zeros(6), np.zeros(6)
    largest = 0.0
    for a in range(len(corners)):
        largest = max(largest, (corners[a] ** 2).sum())
        for c in range(3):
            low_box[c] = min(low_box[c], corners[a, c])
            high_box[c] = max(high_box[c], corners[a, c])
    wide = np.maximum(-low_box[:3], high_box[:3])
    for c in range(3):
        d, e = (c + 1) % 3, (c + 2) % 3
        high_box[3 + c] = half[c] + wide[d] * half[e] + wide[e] * half[d]
        low_box[3 + c] = -high_box[3 + c]
    scale = 1.0 + largest
    goal = cutoff * scale
    delta = np.zeros(6)
    terms = np.empty((7, m, n))
    spent = 0
    for _ in range(_REFITS):
        fit_delta(moved, shifted, col_of, low_box, high_box, delta)
        residuals(moved, shifted, delta, terms)
        value, matching, b = k_assignment_duals(terms[0].T.copy(), k)
        spent += 1
        if value <= floor * scale:  # already at delta, which is a point of the box
            return -np.inf, spent
        if (matching == col_of).all():
            break
        col_of = matching
    free = np.flatnonzero(high_box[3:] > 0.0)
    n_shifts = 1 << free.size
    values = np.empty(len(corners) * n_shifts)
    steps = np.empty((values.size, 6))
    low = np.empty(n)
    for at in range(values.size):
        a, shift = at // n_shifts, at % n_shifts
        steps[at, :3] = corners[a] - delta[:3]
        steps[at, 3:] = -delta[3:]
        for bit in range(free.size):
            c = 3 + free[bit]
            steps[at, c] += high_box[c] if (shift >> bit) & 1 else low_box[c]
        values[at] = dual_bound_at(terms, steps[at], k, b, low)
        if values[at] <= floor * scale:
            return -np.inf, spent
    while values.min() < goal:
        at = values.argmin()
        exact, _, b = k_assignment_duals(linear_costs(terms, steps[at]), k)
        values[at] = exact
        spent += 1
        if exact < goal:
            break
        for v in range(values.size):
            if values[v] < goal:
                values[v] = max(values[v], dual_bound_at(terms, steps[v], k, b, low))
    return max(0.0, values.min()) / scale, spent


@jit
def move(points, shift, out):
    """Subtract a shift from the points; further rows of `out` stay."""
    for c in range(3):
        for j in range(points.shape[1]):
            out[c, j] = points[c, j] - shift[c]


@jit
def matching_value(moved, shifted, col_of):
    """Sum of squared residuals of given pairs."""
    total = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            for c in range(3):
                total += (moved[c, i] - shifted[c, j]) ** 2
    return total


@jit
def bound_boxes(lower, upper, cutoff, source, target, k, bounds, values):
    """Bound every box, cheapest test first; returns the assignments solved.

    `values` receives an upper bound on E at the box centre, +inf where the box was decided before.
    """
    n, m = source.shape[1], target.shape[1]
    reach = column_norms(source)
    radius = math.sqrt((reach**2).mean())
    caps, costs = np.empty((m, n)), np.empty((n, m))
    corners, shifted = np.empty((8, 3)), target.copy()
    spent = 0
    for box in range(len(lower)):
        values[box] = np.inf
        centre = 0.5 * (lower[box] + upper[box])
        half = 0.5 * (upper[box, 4:] - lower[box, 4:])
        count = relative_corners(centre, lower[box], upper[box], corners)
        tangent = 0.0
        for a in range(count):
            tangent = max(tangent, math.sqrt((corners[a] ** 2).sum()))
        angle = 2.0 * math.atan(tangent) if count > 0 else math.pi
        slack = math.sqrt((half**2).sum())
        moved = rotation_matrix(centre[:4]) @ source
        move(target, centre[4:], shifted)

        cap_costs(moved, reach, angle, shifted, caps)
        bounds[box] = nearest_bound(caps, slack, k)
        # however low their bounds, the poses of a small box are alike and must be told from others
        small = k * (angle * radius + slack) ** 2 < cutoff
        if bounds[box] >= cutoff or not (small or bounds[box] > _WORTH_PAIRS * cutoff):
            continue
        pair_costs(moved, reach, angle, shifted, half, costs)
        b = np.zeros(m)
        bid(costs, k, b)
        bounds[box] = max(bounds[box], dual_bound(costs, k, b))
        if bounds[box] >= cutoff or not (small or bounds[box] > _WORTH_ASSIGNMENT * cutoff):
            continue
        value, col_of, b = k_assignment_duals(costs, k)
        bounds[box] = max(bounds[box], value)
        values[box] = matching_value(moved, shifted, col_of)
        spent += 1
        if bounds[box] >= cutoff or count == 0:
            continue
        value, solved = vertex_bound(
            moved, shifted, corners[:count], half, k, bounds[box], cutoff, col_of
        )
        bounds[box] = max(bounds[box], value)
        spent += solved
    return spent


@jit
def fit_rigid(source, target, col_of, theta):
    """Best rigid pose of the matched pairs (Horn 1987, centred): quaternion and translation."""
    mean_x, mean_y = np.zeros(3), np.zeros(3)
    count = 0
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            count += 1
            mean_x += source[:, i]
            mean_y += target[:, j]
    mean_x /= count
    mean_y /= count
    x, y = np.empty_like(source), np.empty((3, target.shape[1]))
    for c in range(3):
        x[c] = source[c] - mean_x[c]
        y[c] = target[c] - mean_y[c]
    theta[:4] = best_rotation(col_of, x, y)
    theta[4:] = mean_y - rotation_matrix(theta[:4]) @ mean_x


@jit
def objective(theta, source, target, k):
    """E at a pose and the column matched to every source point (-1: none)."""
    moved = rotation_matrix(theta[:4]) @ source
    shifted = target.copy()
    move(target, theta[4:], shifted)
    cost = np.empty((source.shape[1], target.shape[1]))
    for i in range(cost.shape[0]):
        for j in range(cost.shape[1]):
            x, y, z = (
                moved[0, i] - shifted[0, j],
                moved[1, i] - shifted[1, j],
                moved[2, i] - shifted[2, j],
            )
            cost[i, j] = x * x + y * y + z * z
    if shifted.shape[0] > 3:
        cost += shifted[3:]
    value, col_of, _ = k_assignment_duals(cost, k)
    return value, col_of


@jit
def nearest_scores(thetas, source, target, k):
    """Sum of the k smallest squared nearest distances at every pose: a cheap guess of E."""
    scores = np.empty(len(thetas))
    reach = column_norms(source)
    caps = np.empty((target.shape[1], source.shape[1]))
    shifted = target.copy()
    for at in range(len(thetas)):
        moved = rotation_matrix(thetas[at, :4]) @ source
        move(target, thetas[at, 4:], shifted)
        cap_costs(moved, reach, 0.0, shifted, caps)
        scores[at] = nearest_bound(caps, 0.0, k)
    return scores


@jit
def refine(theta, source, target, k):
    """Alternate matching and best pose until E no longer falls: theta, E, assignments."""
    best = theta.copy()
    value, col_of = objective(best, source, target, k)
    spent = 1
    trial = np.empty(7)
    for _ in range(_MAX_ROUNDS):
        fit_rigid(source, target, col_of, trial)
        trial_value, trial_col = objective(trial, source, target, k)
        spent += 1
        if trial_value >= value * (1.0 - 1e-12):
            break
        value, col_of = trial_value, trial_col
        best[:] = trial
    return best, value, spent
