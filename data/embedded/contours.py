"""A fish-like and a glyph-like drawing: smooth strokes, sampled at equal arc length."""

from __future__ import annotations

import numpy as np

# Strokes are control points of smooth curves; a closed stroke returns to its first point. The glyph is
# invented and has no meaning.
Stroke = tuple[bool, list[tuple[float, float]]]

FISH: list[Stroke] = [
    # body: snout, back, tail root, belly
    (
        True,
        [
            (0.00, 0.02),
            (0.07, 0.115),
            (0.20, 0.20),
            (0.36, 0.235),
            (0.53, 0.205),
            (0.68, 0.125),
            (0.78, 0.06),
            (0.805, 0.005),
            (0.77, -0.05),
            (0.64, -0.10),
            (0.46, -0.155),
            (0.29, -0.165),
            (0.13, -0.115),
            (0.03, -0.05),
        ],
    ),
    # tail fin, its upper lobe the longer one
    (
        False,
        [
            (0.78, 0.06),
            (0.87, 0.14),
            (0.97, 0.245),
            (1.00, 0.25),
            (0.955, 0.12),
            (0.93, 0.01),
            (0.95, -0.09),
            (0.965, -0.17),
            (0.94, -0.175),
            (0.86, -0.11),
            (0.77, -0.05),
        ],
    ),
    # dorsal fin
    (False, [(0.25, 0.22), (0.35, 0.33), (0.45, 0.385), (0.50, 0.36), (0.54, 0.28), (0.60, 0.17)]),
    # ventral fin
    (False, [(0.33, -0.165), (0.40, -0.25), (0.475, -0.28), (0.48, -0.22), (0.46, -0.155)]),
    # gill, pectoral fin, mouth and eye
    (False, [(0.225, 0.135), (0.265, 0.06), (0.262, -0.02), (0.215, -0.09)]),
    (False, [(0.33, 0.035), (0.43, 0.015), (0.485, -0.045), (0.40, -0.055), (0.33, -0.02)]),
    (False, [(0.00, 0.02), (0.05, 0.002), (0.10, 0.005)]),
    (True, [(0.155, 0.095), (0.13, 0.12), (0.105, 0.095), (0.13, 0.07)]),
]

GLYPH: list[Stroke] = [
    (False, [(0.46, 1.00), (0.52, 0.955), (0.56, 0.90)]),  # dot above
    (False, [(0.08, 0.81), (0.30, 0.835), (0.60, 0.865), (0.93, 0.875)]),  # roof
    (False, [(0.93, 0.875), (0.90, 0.80), (0.85, 0.74)]),  # its hook
    (False, [(0.08, 0.81), (0.07, 0.74), (0.03, 0.67)]),
    (False, [(0.38, 0.82), (0.335, 0.62), (0.23, 0.40), (0.03, 0.17)]),  # falling left
    (False, [(0.235, 0.42), (0.24, 0.25), (0.235, 0.05)]),  # stem
    (False, [(0.45, 0.66), (0.45, 0.55), (0.46, 0.44)]),  # box
    (False, [(0.45, 0.66), (0.63, 0.68), (0.83, 0.69)]),
    (False, [(0.83, 0.69), (0.82, 0.59), (0.79, 0.48)]),
    (False, [(0.46, 0.44), (0.62, 0.455), (0.79, 0.48)]),
    (False, [(0.37, 0.265), (0.62, 0.29), (0.93, 0.315)]),  # crossing
    (False, [(0.645, 0.45), (0.65, 0.25), (0.64, 0.04), (0.585, 0.01), (0.54, 0.05)]),  # hook
    (False, [(0.72, 0.235), (0.82, 0.16), (0.97, 0.075)]),  # falling right
]


def sample_strokes(strokes: list[Stroke], n_points: int) -> np.ndarray:
    """Return `n_points` points over all strokes, in proportion to length, equally spaced on each."""
    curves = [_dense(closed, np.array(points)) for closed, points in strokes]
    lengths = np.array([length[-1] for _, length in curves])
    return np.vstack(
        [
            _along(curve, length, count, closed)
            for (closed, _), (curve, length), count in zip(
                strokes, curves, _shares(lengths, n_points), strict=True
            )
        ]
    )


def _dense(closed: bool, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the curve at many parameters, and the length up to each."""
    from scipy.interpolate import CubicSpline  # takes long to load; a plan needs no points

    if closed:
        control = np.vstack([control, control[:1]])
    chord = np.cumsum(np.r_[0, np.linalg.norm(np.diff(control, axis=0), axis=1) ** 0.5])
    spline = CubicSpline(chord, control, bc_type="periodic" if closed else "natural")
    curve = spline(np.linspace(0, chord[-1], 400))
    return curve, np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]


def _along(curve: np.ndarray, length: np.ndarray, count: int, closed: bool) -> np.ndarray:
    # Open strokes are sampled at the middle of equal pieces: ends shared by two strokes would
    # otherwise be duplicate points.
    at = (np.arange(count) + (0.0 if closed else 0.5)) / max(count, 1) * length[-1]
    return np.column_stack([np.interp(at, length, axis) for axis in curve.T])


def _shares(weights: np.ndarray, total: int) -> np.ndarray:
    """Return integers with sum `total` in proportion to `weights` (largest remainder)."""
    exact = weights / weights.sum() * total
    shares = np.floor(exact).astype(int)
    shares[np.argsort(shares - exact, kind="stable")[: total - shares.sum()]] += 1
    return shares
