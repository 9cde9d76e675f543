"""Colours, markers, dashes and number formats of all figures and tables."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from baselines import registry
from dcreg import text
from reports.tables import Tables
from workflows.labels import distinct

SURFACE = {"light": "#ffffff", "dark": "#161b22"}
SOURCE_COLOR = {"light": "#c62828", "dark": "#ff8a80"}  # red circles, as in the paper
TARGET_COLOR = {"light": "#1565c0", "dark": "#82b1ff"}  # blue crosses
# Parts of the drawings of the method.
PART_COLORS = {
    "convex": {"light": "#8a5a00", "dark": "#e3b341"},
    "concave": {"light": "#00795b", "dark": "#5fd3b0"},
    "objective": {"light": "#5b6570", "dark": "#b4bec8"},
    "bound": {"light": "#8c1d1d", "dark": "#ff9a8f"},
    "fixed": {"light": "#6f7fb5", "dark": "#8f9fd6"},
}
OUTCOME_COLOR = {
    "finished": "#2e7d5b",
    "limited": "#c98a12",
    "failed": "#c0392b",
    "unsupported": "#8d99a6",
    "unavailable": "#b9c1c9",
    "not_needed": "#dfe3e7",
}
FALLBACK_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6a51a3")

LIMITED, NO_POSE = "-open", "-open-dot"  # endings of plotly's symbols

# matplotlib marker -> plotly symbol and its outline on the unit circle. Only filled shapes: open markers
# mark runs at a limit. Variants of a method take the markers after that of its card, in this order.
_MARKERS: dict[str, tuple[str, int, float, float]] = {
    # symbol, number of corners, turn of the first one, inner radius of a star (1: a polygon)
    "o": ("circle", 24, 0.0, 1.0),
    "s": ("square", 4, 0.125, 1.0),
    "^": ("triangle-up", 3, 0.0, 1.0),
    "D": ("diamond", 4, 0.0, 1.0),
    "X": ("x", 4, 0.125, 0.3),
    "v": ("triangle-down", 3, 0.5, 1.0),
    "P": ("cross", 4, 0.0, 0.3),
    "*": ("star", 5, 0.0, 0.4),
    "<": ("triangle-left", 3, 0.75, 1.0),
    "d": ("diamond-tall", 2, 0.0, 0.55),
    ">": ("triangle-right", 3, 0.25, 1.0),
    "p": ("pentagon", 5, 0.0, 1.0),
    "h": ("hexagon", 6, 0.0, 1.0),
    "H": ("hexagon2", 6, 1 / 12, 1.0),
    "8": ("octagon", 8, 1 / 16, 1.0),
}
MARKERS = tuple(_MARKERS)
# Plotly's name of the dash -> lengths of strokes and gaps, in line widths.
DASHES: dict[str, tuple[float, ...]] = {
    "solid": (),
    "dash": (5, 2),
    "dot": (1, 1.5),
    "dashdot": (5, 2, 1, 2),
    "longdash": (9, 2),
    "longdashdot": (9, 2, 1, 2),
}
_LOOKS = len(MARKERS) * len(DASHES)
# Words in the names of variants -> look, the same in every experiment.
_VARIANTS = {
    "half": 1, "given": 3, "exact": 1, "100": 1, "mutual": 1,
    "paper": 2, "dc": 2, "ours": 2, "oracle": 2, "200": 2,
    "full": 3, "nearest": 3, "tight": 4, "all": 4, "fpfh": 5, "pose": 17,
    "several": 5, "multi": 6, "norm": 6,
}  # fmt: skip
# Lightness of methods in OKLab: the range in cards, and the legible range on each surface.
_IN_CARDS = (0.3, 0.9)
_LIGHTNESS = {"light": (0.28, 0.66), "dark": (0.54, 0.96)}
_TO_CONES = np.array([[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]])
_TO_OKLAB = np.array(
    [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]
)

MISSING = "–"


@dataclass(frozen=True)
class Style:
    """The look of one method: colour × marker × dash."""

    label: str
    name: str
    variable: str  # CSS custom property with its colour in both themes
    light: str
    dark: str
    marker: str
    dash: str

    @property
    def symbol(self) -> str:
        return _MARKERS[self.marker][0]

    @property
    def strokes(self) -> str:
        """The dash in SVG's notation."""
        return " ".join(f"{1.6 * length:g}" for length in DASHES[self.dash])

    @property
    def outline(self) -> str:
        """The marker as an SVG polygon around 0 with radius 1."""
        _, corners, turn, inner = _MARKERS[self.marker]
        points = []
        for corner in range(corners if inner == 1 else 2 * corners):
            angle = 2 * math.pi * (turn + corner / (corners if inner == 1 else 2 * corners))
            radius = inner if corner % 2 and inner != 1 else 1.0
            points.append(f"{radius * math.sin(angle):.2f},{-radius * math.cos(angle):.2f}")
        return " ".join(points)


def method_styles(tables: Tables) -> dict[str, Style]:
    """Return a distinct style per method, the same in every experiment.

    Methods of a family share a colour. The marker is that of the method's card; variants of a method have
    other markers and dashes.
    """
    first = tables.runs.drop_duplicates("method").set_index("method")
    names = distinct({label: str(first.loc[label, "display_name"]) for label in tables.methods})
    used: set[tuple[str, str, str]] = set()
    styles = {}
    for index, label in enumerate(tables.methods):
        card = tables.cards.get(label, {})
        color, marker = _card_look(card, FALLBACK_COLORS[index % len(FALLBACK_COLORS)])
        variant = _variant(label, card)
        looks = [_nth_look(marker, variant + step) for step in range(_LOOKS)]
        look = next((look for look in looks if (color, *look) not in used), looks[0])
        used.add((color, *look))
        styles[label] = Style(
            label=label,
            name=names[label],
            variable=f"--method-{index}",
            light=on_surface(color, "light"),
            dark=on_surface(color, "dark"),
            marker=look[0],
            dash=look[1],
        )
    return styles


def _card_look(card: dict[str, Any], otherwise: str) -> tuple[str, str]:
    """Return colour and marker of a method: those of its present card, also for older tables."""
    baseline = str(card.get("baseline", ""))
    if baseline in registry.names():
        present = registry.read_card(baseline)
        return present.color, present.marker
    marker = str(card.get("marker", "o"))
    return str(card.get("color") or otherwise), marker if marker in _MARKERS else "o"


def _nth_look(marker: str, n: int) -> tuple[str, str]:
    """Return marker and dash of the n-th variant; all pairs of the two occur before one repeats."""
    place = MARKERS.index(marker) + n + n // math.lcm(len(MARKERS), len(DASHES))
    return MARKERS[place % len(MARKERS)], list(DASHES)[n % len(DASHES)]


def _variant(label: str, card: dict[str, Any]) -> int:
    """Return 0 for the main row of a method, otherwise a number by the words of its name."""
    is_plain = not card.get("options") and card.get("n_inliers_ratio", 1) == 1
    if is_plain or "-" not in label:
        return 0
    known = [_VARIANTS[word] for word in label.split("-")[1:] if word in _VARIANTS]
    return sum(look * len(DASHES) ** place for place, look in enumerate(known[:2])) or 1


def on_surface(color: str, surface: str) -> str:
    """Return the colour of a method on the surface ``light`` or ``dark``.

    The lightness is moved into the range that is legible there, so that colours keep their order.
    """
    lightness, *hue = _oklab(color)
    wanted = float(np.interp(lightness, _IN_CARDS, _LIGHTNESS[surface]))
    for chroma in np.linspace(1.0, 0.0, 41):  # the display shows only some colours of a lightness
        cones = np.linalg.solve(_TO_OKLAB, [wanted, *(chroma * np.array(hue))]) ** 3
        linear = np.linalg.solve(_TO_CONES, cones)
        if linear.min() >= -1e-3 and linear.max() <= 1.0 + 1e-3:
            break
    return readable(hex_of(linear), SURFACE[surface], ratio=3.0)


def difference(one: str, other: str) -> float:
    """Return the distance of two colours in OKLab; 0.02 is just noticeable."""
    return math.dist(_oklab(one), _oklab(other))


def _oklab(color: str) -> tuple[float, ...]:
    return tuple(_TO_OKLAB @ np.cbrt(_TO_CONES @ linear_rgb(color)))


def linear_rgb(color: str) -> np.ndarray:
    """Return a hex colour in linear RGB, from 0 to 1."""
    encoded = np.array(_channels(color))
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def hex_of(linear: np.ndarray) -> str:
    """Return a colour in linear RGB as hex; values outside 0 to 1 are clipped."""
    clipped = np.clip(linear, 0.0, 1.0)
    encoded = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    return "#" + "".join(f"{round(255 * value):02x}" for value in encoded)


def readable(color: str, surface: str, ratio: float = 3.2) -> str:
    """Return `color`, moved away from `surface` until it reaches a contrast `ratio`."""
    away = "#ffffff" if _luminance(surface) < 0.5 else "#000000"
    for step in range(21):
        candidate = mix(color, away, step / 20)
        if contrast(candidate, surface) >= ratio:
            return candidate
    return away


def contrast(one: str, other: str) -> float:
    """Return the WCAG contrast ratio of two colours."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def mix(color: str, other: str, amount: float) -> str:
    """Return a linear blend of two hex colours."""
    pairs = zip(_channels(color), _channels(other), strict=True)
    return "#" + "".join(f"{round(255 * (a + (b - a) * amount)):02x}" for a, b in pairs)


def _channels(color: str) -> list[float]:
    return [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]


def _luminance(color: str) -> float:
    return float(linear_rgb(color) @ [0.2126, 0.7152, 0.0722])


def number(value: float | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits."""
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if size < -4 or size > 5:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - size)}f}"


def percent(value: float | None) -> str:
    return MISSING if value is None or math.isnan(value) else f"{100 * value:.0f} %"


def share(value: float, low: float, high: float) -> str:
    """Format a share of runs with its interval."""
    return f"{100 * value:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def proven(value: float | None) -> str:
    """Format L/U, rounded down: only a closed gap is 100 %."""
    return MISSING if value is None or math.isnan(value) else text.percent(value)


def seconds(value: float | None) -> str:
    """Format a duration with its unit: µs, ms, s or min."""
    if value is None or math.isnan(value):
        return MISSING
    for limit, factor, unit in ((1e-3, 1e6, "µs"), (1.0, 1e3, "ms"), (120.0, 1.0, "s")):
        if value < limit:
            return f"{number(value * factor)} {unit}"
    return f"{number(value / 60)} min"


def integer(value: float) -> str:
    return MISSING if math.isnan(value) else f"{value:,.0f}".replace(",", "\u202f")


def sortable(value: float | None) -> str:
    """Return the sort key of a number in a table; empty if it is missing."""
    if value is None or math.isnan(value):
        return ""
    return str(float(value)).replace("inf", "Infinity")


def listed(names: list[str]) -> str:
    """Return names as in a sentence: ``A, B and C``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def words(name: str) -> str:
    """Return a name of the tables as words: ``mixed_outliers`` becomes mixed outliers."""
    return name.replace("_", " ")


def css_variables(styles: Iterable[Style]) -> str:
    """Return CSS custom properties for the colours in both themes."""
    pairs = [(style.variable, style.light, style.dark) for style in styles]
    pairs += [("--source", SOURCE_COLOR["light"], SOURCE_COLOR["dark"])]
    pairs += [("--target", TARGET_COLOR["light"], TARGET_COLOR["dark"])]
    pairs += [
        (f"--{name}", readable(color, SURFACE["light"], 1.7), readable(color, SURFACE["dark"], 1.7))
        for name, color in OUTCOME_COLOR.items()
    ]
    lines = [f"{name}: light-dark({light}, {dark});" for name, light, dark in pairs]
    return ":root { " + " ".join(lines) + " }"
