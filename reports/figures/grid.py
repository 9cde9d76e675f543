"""Panels in rows and columns on a wide screen, stacked in one column on a narrow one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

_ROW_PX, _GAP_PX, _TOP_PX, _BOTTOM_PX = 190, 34, 50, 52
_NARROW_ROW_PX, _NARROW_GAP_PX = 170, 68


@dataclass
class Panel:
    """One pair of axes."""

    row: int
    column: int
    x_title: str
    y_title: str
    x_type: str = "linear"
    y_type: str = "linear"
    share_x: bool = True
    share_y: bool = True
    y_from_zero: bool = False
    x_ticks: list[float] = field(default_factory=list)  # empty: automatic
    equal: bool = False  # both axes in the same unit
    hidden: bool = False  # axes without numbers, for clouds


@dataclass
class Grid:
    """Axes of a small-multiples figure, with a wide and a narrow layout of the same axes."""

    column_titles: list[str]
    panels: list[Panel] = field(default_factory=list)
    row_px: int = _ROW_PX  # height of a panel

    def add(self, panel: Panel) -> tuple[str, str]:
        """Append a panel; return the names of its axes for traces, such as ``("x2", "y2")``."""
        self.panels.append(panel)
        return _axis("x", len(self.panels)), _axis("y", len(self.panels))

    def layouts(self) -> dict[str, Any]:
        return {"wide": self._wide(), "narrow": self._narrow()}

    def axes(self, letter: str, rows: set[int]) -> list[str]:
        """Return the layout names of the axes in `rows`, for the scale switches."""
        return [
            _key(letter, index) for index, panel in enumerate(self.panels, 1) if panel.row in rows
        ]

    def _wide(self) -> dict[str, Any]:
        rows = max(panel.row for panel in self.panels) + 1
        columns = len(self.column_titles)
        height = _TOP_PX + rows * self.row_px + (rows - 1) * _GAP_PX + _BOTTOM_PX
        inner = height - _TOP_PX - _BOTTOM_PX
        gap = 0.035 if columns > 2 else 0.09
        width = (1 - gap * (columns - 1)) / columns
        layout: dict[str, Any] = {"height": height, "margin": _margin(72)}
        lowest = {c: max(p.row for p in self.panels if p.column == c) for c in range(columns)}
        for index, panel in enumerate(self.panels, 1):
            left = panel.column * (width + gap)
            top = 1 - panel.row * (self.row_px + _GAP_PX) / inner
            last = panel.row == lowest[panel.column] or not panel.share_x
            self._place(
                layout, index, (left, left + width), (max(0, top - self.row_px / inner), top),
                x_title=panel.x_title if last else "",
                y_title=panel.y_title if panel.column == 0 or not panel.share_y else "",
                show_x=last,
                show_y=panel.column == 0 or not panel.share_y,
            )  # fmt: skip
        layout["annotations"] = [
            _heading(title, c * (width + gap), 1.0)
            for c, title in enumerate(self.column_titles)
            if title
        ]
        return layout

    def _narrow(self) -> dict[str, Any]:
        order = sorted(
            range(len(self.panels)), key=lambda i: (self.panels[i].column, self.panels[i].row)
        )
        count = len(order)
        row_px = _NARROW_ROW_PX * self.row_px // _ROW_PX
        height = _TOP_PX + count * row_px + (count - 1) * _NARROW_GAP_PX + _BOTTOM_PX
        inner = height - _TOP_PX - _BOTTOM_PX
        layout: dict[str, Any] = {"height": height, "margin": _margin(44), "annotations": []}
        seen: set[int] = set()
        for position, which in enumerate(order):
            panel = self.panels[which]
            top = 1 - position * (row_px + _NARROW_GAP_PX) / inner
            self._place(
                layout, which + 1, (0, 1), (max(0, top - row_px / inner), top),
                x_title=panel.x_title, y_title=panel.y_title, show_x=True, show_y=True,
            )  # fmt: skip
            title = self.column_titles[panel.column]
            if panel.column not in seen and title:
                layout["annotations"].append(_heading(title, 0, top))
            seen.add(panel.column)
        return layout

    def _place(
        self,
        layout: dict[str, Any],
        index: int,
        x_domain: tuple[float, float],
        y_domain: tuple[float, float],
        *,
        x_title: str,
        y_title: str,
        show_x: bool,
        show_y: bool,
    ) -> None:
        panel = self.panels[index - 1]
        x_axis = {
            "domain": list(x_domain),
            "anchor": _axis("y", index),
            "type": panel.x_type,
            "title": {"text": x_title, "standoff": 6},
            "showticklabels": show_x,
        }
        y_axis = {
            "domain": list(y_domain),
            "anchor": _axis("x", index),
            "type": panel.y_type,
            "title": {"text": y_title, "standoff": 6},
            "showticklabels": show_y,
            "automargin": "left",
        }
        if panel.y_from_zero:
            y_axis["rangemode"] = "tozero"
        if panel.x_ticks:
            x_axis |= {"tickvals": panel.x_ticks, "ticktext": [f"{x:g}" for x in panel.x_ticks]}
        if panel.equal:
            y_axis["scaleanchor"] = _axis("x", index)
        if panel.hidden:
            for axis in (x_axis, y_axis):
                axis |= {
                    "showticklabels": False,
                    "showgrid": False,
                    "zeroline": False,
                    "showline": False,
                }
        first_x, first_y = self.first_of_column(index - 1) + 1, self.first_of_row(index - 1) + 1
        if first_x != index:
            x_axis["matches"] = _axis("x", first_x)
        if first_y != index:
            y_axis["matches"] = _axis("y", first_y)
        layout[_key("x", index)], layout[_key("y", index)] = x_axis, y_axis

    def first_of_column(self, which: int) -> int:
        """Return the index of the first panel that shares its x axis with this one."""
        panel = self.panels[which]
        if not panel.share_x:
            return which
        return next(
            i
            for i, other in enumerate(self.panels)
            if other.column == panel.column and other.share_x
        )

    def first_of_row(self, which: int) -> int:
        """Return the index of the first panel that shares its y axis with this one."""
        panel = self.panels[which]
        if not panel.share_y:
            return which
        return next(
            i for i, other in enumerate(self.panels) if other.row == panel.row and other.share_y
        )


def _axis(letter: str, index: int) -> str:
    """Plotly's name of an axis: x, x2, x3, ..."""
    return letter if index == 1 else f"{letter}{index}"


def _key(letter: str, index: int) -> str:
    """The layout entry of that axis: xaxis, xaxis2, ..."""
    return _axis(f"{letter}axis", index)


def _margin(left: int) -> dict[str, int]:
    return {"l": left, "r": 12, "t": _TOP_PX, "b": _BOTTOM_PX}


def _heading(text: str, x: float, y: float) -> dict[str, Any]:
    return {
        "text": f"<b>{text}</b>", "x": x, "y": y, "xref": "paper", "yref": "paper",
        "xanchor": "left", "yanchor": "bottom", "yshift": 4, "showarrow": False,
    }  # fmt: skip
