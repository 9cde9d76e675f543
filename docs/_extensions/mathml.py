"""Formulas as MathML, which browsers show by themselves: no script, no font, no network."""

from docutils import nodes
from docutils.utils.math import latex2mathml

# Bars are fences here, never binary operators: without the space of those.
_BARS = ('<mo class="mathopen">|</mo>', '<mo stretchy="false">|</mo>', "<mo>|</mo>")
_FENCE = '<mo lspace="0" rspace="0" stretchy="false">|</mo>'


def mathml(formula: str, as_block: bool = False) -> str:
    markup = latex2mathml.tex2mathml(formula, as_block)
    for bar in _BARS:
        markup = markup.replace(bar, _FENCE)
    return markup


def inline(translator, node):
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def block(translator, node):
    translator.body.append(f'<div class="formula">{mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app):
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True}
