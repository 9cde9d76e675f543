"""The one place for colours, markers, fonts and number formats of every figure and table."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from reports.tables import Tables

SURFACE = {"light": "#ffffff", "dark": "#161b22"}
SOURCE_COLOR = {"light": "#c62828", "dark": "#ff8a80"}  # red circles, as in the paper
TARGET_COLOR = {"light": "#1565c0", "dark": "#82b1ff"}  # blue crosses
OUTCOME_COLOR = {
    "finished": "#2e7d5b",
    "limited": "#c98a12",
    "failed": "#c0392b",
    "unsupported": "#8d99a6",
    "unavailable": "#b9c1c9",
}
FALLBACK_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6a51a3")

# matplotlib marker -> plotly symbol; a card states the former.
_SYMBOLS = {
    "o": "circle",
    "s": "square",
    "^": "triangle-up",
    "v": "triangle-down",
    "<": "triangle-left",
    ">": "triangle-right",
    "D": "diamond",
    "d": "diamond-tall",
    "P": "cross",
    "X": "x",
    "x": "x",
    "+": "cross",
    "*": "star",
    "p": "pentagon",
    "h": "hexagon",
}
# Variants of one method share its colour family and differ by dash.
_DASHES = ("solid", "dash", "dot", "dashdot")

MISSING = "–"


@dataclass(frozen=True)
class Style:
    """How one method looks everywhere."""

    label: str
    name: str
    variable: str  # CSS custom property that holds its colour in either theme
    light: str
    dark: str
    marker: str
    symbol: str
    dash: str

    @property
    def mpl_line(self) -> str:
        return {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}[self.dash]


def method_styles(tables: Tables) -> dict[str, Style]:
    """A style per method label, from the method cards; variants stay distinguishable."""
    first = tables.runs.drop_duplicates("method").set_index("method")
    names = first["display_name"].to_dict()
    used: dict[str, int] = {}
    styles = {}
    for index, label in enumerate(tables.methods):
        card = tables.cards.get(label, {})
        color = str(card.get("color") or FALLBACK_COLORS[index % len(FALLBACK_COLORS)])
        variant = used.get(color, 0)
        used[color] = variant + 1
        shared = list(names.values()).count(names[label]) > 1
        shade = mix(color, "#ffffff" if variant % 2 else "#000000", 0.28 * min(variant, 2))
        marker = str(card.get("marker", "o"))
        styles[label] = Style(
            label=label,
            name=label if shared or not names[label] else names[label],
            variable=f"--method-{index}",
            light=readable(shade, SURFACE["light"]),
            dark=readable(shade, SURFACE["dark"]),
            marker=marker if marker in _SYMBOLS else "o",
            symbol=_SYMBOLS.get(marker, "circle"),
            dash=_DASHES[variant % len(_DASHES)],
        )
    return styles


def readable(color: str, surface: str, ratio: float = 3.2) -> str:
    """`color`, moved away from `surface` until it reaches the contrast asked of graphics."""
    away = "#ffffff" if _luminance(surface) < 0.5 else "#000000"
    for step in range(21):
        candidate = mix(color, away, step / 20)
        if contrast(candidate, surface) >= ratio:
            return candidate
    return away


def contrast(one: str, other: str) -> float:
    """WCAG contrast ratio of two colours."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def mix(color: str, other: str, amount: float) -> str:
    """Linear blend of two hex colours."""
    pairs = zip(_channels(color), _channels(other), strict=True)
    return "#" + "".join(f"{round(255 * (a + (b - a) * amount)):02x}" for a, b in pairs)


def _channels(color: str) -> list[float]:
    return [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]


def _luminance(color: str) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in _channels(color)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def number(value: float | None, digits: int = 3) -> str:
    """`digits` significant digits, without needless exponents."""
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


def seconds(value: float | None) -> str:
    """A duration with its unit: µs, ms, s or min."""
    if value is None or math.isnan(value):
        return MISSING
    for limit, factor, unit in ((1e-3, 1e6, "µs"), (1.0, 1e3, "ms"), (120.0, 1.0, "s")):
        if value < limit:
            return f"{number(value * factor)} {unit}"
    return f"{number(value / 60)} min"


def integer(value: float) -> str:
    return f"{value:,.0f}".replace(",", "\u202f")


def sortable(value: float | None) -> str:
    """What a table sorts a number by; empty when it is missing."""
    if value is None or math.isnan(value):
        return ""
    return str(float(value)).replace("inf", "Infinity")


def words(name: str) -> str:
    """A name of the tables as a reader expects it: ``mixed_outliers`` is mixed outliers."""
    return name.replace("_", " ")


def css_variables(styles: Iterable[Style]) -> str:
    """Custom properties for the colours that follow the theme."""
    pairs = [(style.variable, style.light, style.dark) for style in styles]
    pairs += [("--source", SOURCE_COLOR["light"], SOURCE_COLOR["dark"])]
    pairs += [("--target", TARGET_COLOR["light"], TARGET_COLOR["dark"])]
    pairs += [
        (f"--{name}", readable(color, SURFACE["light"], 1.7), readable(color, SURFACE["dark"], 1.7))
        for name, color in OUTCOME_COLOR.items()
    ]
    lines = [f"{name}: light-dark({light}, {dark});" for name, light, dark in pairs]
    return ":root { " + " ".join(lines) + " }"
