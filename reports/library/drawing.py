"""Small drawings as SVG, in the colours of the page: thumbnails and the figure of difficulty."""

from __future__ import annotations

import numpy as np
import pandas as pd

from data.fetch import UnavailableError, without_origins
from data.library.problem import Problem
from data.library.record import Record
from dcreg.problem import apply_pose
from reports.library.difficulty import LABELS, LOGARITHMIC

THUMB = 56  # side, in units of the drawing
PANEL = (300, 210)  # width and height
MARGIN = (44, 14, 14, 36)  # left, right, top, bottom
VIEW = np.array([[0.866, -0.5, 0.0], [0.3, 0.52, 0.8]])  # rows: right and up; as in common.js


def flat(points: np.ndarray) -> np.ndarray:
    """Return points as seen on the page, y upwards."""
    return points if points.shape[1] == 2 else points @ VIEW.T


def thumbnail(problem: Problem, record: Record) -> str:
    """Draw both clouds at the best pose; empty if there is no pose, or the points are not available."""
    clouds = _placed(problem, record)
    dots = ["".join(f"M{x:.0f} {y:.0f}h0" for x, y in points) for points in clouds]
    return _drawing("thumb", *dots) if dots else ""


def picture(problem: Problem, record: Record) -> str:
    """Draw what `thumbnail` does larger: circles and crosses, as in the view of other problems."""
    if not (clouds := _placed(problem, record)):
        return ""
    source, target = clouds
    circles = "".join(f"M{x - 0.5:.1f} {y:.1f}a.5.5 0 1 0 1 0a.5.5 0 1 0-1 0" for x, y in source)
    crosses = "".join(f"M{x - 0.5:.1f} {y:.1f}h1m-.5-.5v1" for x, y in target)
    return _drawing("still", circles, crosses)


def _drawing(name: str, source: str, target: str) -> str:
    return (
        f'<svg class="{name}" viewBox="0 0 {THUMB} {THUMB}" aria-hidden="true">'
        f'<path class="s" d="{source}"/><path class="t" d="{target}"/></svg>'
    )


def _placed(problem: Problem, record: Record) -> list[np.ndarray]:
    """Return source at the best pose and target in the square of a drawing, or nothing."""
    if record.best_pose is None:
        return []
    try:
        with without_origins():  # no download for a picture
            source, target = problem.clouds
    except UnavailableError:
        return []
    clouds = [flat(apply_pose(np.array(record.best_pose.pose), source)), flat(target)]
    every = np.vstack(clouds)
    low, extent = every.min(axis=0), np.ptp(every, axis=0)
    scale = (THUMB - 6) / max(extent.max(), 1e-9)
    corner = 3 + (THUMB - 6 - extent * scale) / 2
    across, up = np.array([1.0, -1.0]), np.array([0.0, THUMB])
    return [up + across * (corner + (points - low) * scale) for points in clouds]


def panels(rows: pd.DataFrame) -> list[tuple[str, str]]:
    """Return a panel per feature: its label, and CPU time against the feature as SVG."""
    return [(label, _panel(rows, name, label)) for name, label in LABELS.items()]


def _panel(rows: pd.DataFrame, name: str, label: str) -> str:
    width, height = PANEL
    left, right, top, bottom = MARGIN
    is_log = name in LOGARITHMIC
    values = rows[name].to_numpy(float)
    x = np.log10(values.clip(1e-3)) if is_log else values
    y = np.log10(rows["cpu_s"].to_numpy(float))
    x_range, y_range = _range(x, is_log), (np.floor(y.min()), np.ceil(y.max()))

    def at(u: float, v: float) -> tuple[float, float]:
        across = (u - x_range[0]) / (x_range[1] - x_range[0])
        up = (v - y_range[0]) / (y_range[1] - y_range[0])
        return left + across * (width - left - right), height - bottom - up * (
            height - top - bottom
        )

    parts = [
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="CPU time against {label}">'
    ]
    for power in range(int(y_range[0]), int(y_range[1]) + 1):
        _, v = at(x_range[0], power)
        parts.append(f'<path class="grid" d="M{left} {v:.1f}H{width - right}"/>')
        parts.append(f'<text class="end" x="{left - 5}" y="{v + 4:.1f}">{10.0**power:g}</text>')
    for tick in np.linspace(*x_range, 4):
        u, _ = at(tick, y_range[0])
        value = 10.0**tick if is_log else tick
        parts.append(f'<text class="mid" x="{u:.1f}" y="{height - 20}">{_short(value)}</text>')
    parts.append(f'<text class="mid" x="{(left + width) / 2}" y="{height - 4}">{label}</text>')
    for row, u, v in zip(rows.itertuples(), x, y, strict=True):
        cx, cy = at(u, v)
        shape = f"M{cx:.1f} {cy:.1f}h0"
        if row.model == "rigid3d":
            shape = f"M{cx - 2.5:.1f} {cy + 2:.1f}l2.5 -4.5 2.5 4.5z"
        parts.append(
            f'<path class="dot3 {row.status}" d="{shape}"><title>{row.problem}</title></path>'
        )
    return "".join([*parts, "</svg>"])


def _range(values: np.ndarray, is_log: bool) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    pad = 0.04 * (high - low) or 0.5
    return (low - pad if is_log else max(low - pad, 0.0)), high + pad


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
