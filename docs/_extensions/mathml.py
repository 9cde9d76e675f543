"""Formulas as MathML, which browsers display without scripts, fonts or a network."""

from docutils import nodes
from docutils.utils.math import latex2mathml

# Bars are fences here, not binary operators, so they get no space. Braces keep their size.
_BARS = ('<mo class="mathopen">|</mo>', '<mo stretchy="false">|</mo>', "<mo>|</mo>")
_REPLACED = dict.fromkeys(_BARS, '<mo lspace="0" rspace="0" stretchy="false">|</mo>') | {
    f"<mo>{brace}</mo>": f'<mo stretchy="false">{brace}</mo>' for brace in "{}"
}


def mathml(formula: str, as_block: bool = False) -> str:
    markup = latex2mathml.tex2mathml(formula, as_block)
    for old, new in _REPLACED.items():
        markup = markup.replace(old, new)
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
