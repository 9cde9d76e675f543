"""Linear functions below products and squares over intervals (McCormick)."""

from __future__ import annotations

from dcreg.jit import jit


@jit
def product_range(a, b, lower, upper):
    """Range of t_a t_b over the box."""
    if a == b:
        near = max(lower[a], -upper[a], 0.0)
        far = max(-lower[a], upper[a])
        return near * near, far * far
    p, q = lower[a] * lower[b], lower[a] * upper[b]
    r, s = upper[a] * lower[b], upper[a] * upper[b]
    return min(p, q, r, s), max(p, q, r, s)


@jit
def relax_product(c, ul, uh, vl, vh):
    """c u v >= cu u + cv v + c0 on the rectangle: the mean of the two active McCormick facets."""
    um, vm = 0.5 * (ul + uh), 0.5 * (vl + vh)
    corner = ul * vl + uh * vh if c >= 0.0 else ul * vh + uh * vl
    return c * vm, c * um, -0.5 * c * corner


@jit
def relax_square(c, low, high):
    """c t^2 >= c1 t + c0: the tangent at the middle when convex, the secant otherwise."""
    if c >= 0.0:
        middle = 0.5 * (low + high)
        return 2.0 * c * middle, -c * middle * middle
    return c * (low + high), -c * low * high


@jit
def least_product(c, low, high):
    """Least of c t for t in [low, high]."""
    return c * low if c >= 0.0 else c * high
