"""Lower bounds on the costs of pairs if the source may rotate within a cap."""

from __future__ import annotations

import math

from dcreg.families.kernels import add_penalty
from dcreg.jit import jit_inner


@jit_inner
def cap_costs(moved, angle, target, penalty, out):
    """Fill (n, m) minimum squared residuals if `moved` may rotate by up to `angle`, with penalties."""
    cosine, sine = math.cos(angle), math.sin(angle)
    for i in range(moved.shape[1]):
        x, y, z = moved[0, i], moved[1, i], moved[2, i]
        own = x * x + y * y + z * z
        for j in range(target.shape[1]):
            u, v, w = target[0, j], target[1, j], target[2, j]
            other = u * u + v * v + w * w
            reach = math.sqrt(own * other)
            dot = x * u + y * v + z * w
            rotated = dot * cosine + math.sqrt(max(0.0, reach * reach - dot * dot)) * sine
            best = reach if dot >= reach * cosine else rotated
            out[i, j] = max(0.0, own + other - 2.0 * best)
    add_penalty(penalty, out)
