"""A page that needs no network: one template for registrations and sweeps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape

_STYLE = """
:root { color-scheme: light dark; --ink: #1f2328; --soft: #59636e; --line: #d1d9e0; --back: #ffffff;
  --warn: #7a4b00; --warn-back: #fff4d6; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --soft: #9aa4af; --line: #3d444d; --back: #0d1117;
    --warn: #f2cc60; --warn-back: #2b2311; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1360px; padding: 20px clamp(12px, 3vw, 32px); color: var(--ink);
  background: var(--back); font: 15px/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { margin: 0; font-size: 1.4rem; line-height: 1.3; }
p { margin: 6px 0; }
.notes { color: var(--soft); }
.warnings { margin: 12px 0; padding: 8px 12px 8px 28px; color: var(--warn); background: var(--warn-back);
  border-radius: 6px; }
dl { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 290px), 1fr));
  gap: 8px 24px; margin: 16px 0; }
dt { color: var(--soft); font-size: 13px; }
dd { margin: 0; white-space: pre-wrap; }
.long { grid-column: 1 / -1; }
.long dd { font: 12px/1.5 ui-monospace, monospace; white-space: pre; overflow-x: auto; }
.scroll { overflow-x: auto; margin: 16px 0; }
table { border-collapse: collapse; white-space: nowrap; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 10px; text-align: right; border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-size: 13px; font-weight: normal; }
.figures { display: grid; grid-template-columns: minmax(0, 1fr); gap: 24px; margin: 12px 0; }
@media (min-width: 1000px) { .figures { grid-template-columns: repeat(2, minmax(0, 1fr)); } }
figure { margin: 0; min-width: 0; }
figcaption { font-weight: 600; }
.plot { height: 420px; }
.plot .infolayer text, .plot .xaxislayer-above text, .plot .yaxislayer-above text {
  fill: var(--ink) !important; }
"""


@dataclass(frozen=True)
class Page:
    """What a page shows, from top to bottom.

    Attributes
    ----------
    title, status : str
    warnings : sequence of str
    facts : sequence of (name, value)
        A value of several lines is shown as it stands.
    headings, rows : sequences
        A table.
    notes : sequence of str
        Lines below the table.
    figures : mapping
        Caption and HTML of every figure.
    script : str
        What the figures need.
    """

    title: str
    status: str
    figures: Mapping[str, str]
    script: str
    warnings: Sequence[str] = ()
    facts: Sequence[tuple[str, str]] = ()
    headings: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    notes: Sequence[str] = ()

    def html(self) -> str:
        """The whole document."""
        return "\n".join(
            [
                '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
                '<meta name="viewport" content="width=device-width, initial-scale=1">',
                f"<title>{escape(self.title)}</title>",
                f"<style>{_STYLE}</style>",
                f"<script>{self.script}</script>\n</head>\n<body>",
                *self._body(),
                "</body>\n</html>\n",
            ]
        )

    def _body(self) -> Iterator[str]:
        yield f"<h1>{escape(self.title)}</h1>"
        yield f'<p class="status">{escape(self.status)}</p>'
        if self.warnings:
            items = "".join(f"<li>{escape(warning)}</li>" for warning in self.warnings)
            yield f'<ul class="warnings">{items}</ul>'
        yield '<div class="figures">'
        for caption, figure in self.figures.items():
            yield f"<figure><figcaption>{escape(caption)}</figcaption>"
            yield f'<div class="plot">{figure}</div></figure>'
        yield "</div>"
        if self.facts:
            yield f"<dl>{''.join(_fact(name, value) for name, value in self.facts)}</dl>"
        if self.rows:
            head = _cells("th", self.headings)
            body = "\n".join(_cells("td", row) for row in self.rows)
            yield f'<div class="scroll"><table>\n{head}\n{body}\n</table></div>'
        for note in self.notes:
            yield f'<p class="notes">{escape(note)}</p>'


def _fact(name: str, value: str) -> str:
    kind = ' class="long"' if "\n" in value else ""
    return f"<div{kind}><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"


def _cells(tag: str, values: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{escape(value)}</{tag}>' for value in values)}</tr>"
