"""Render mathematics as MathML, which browsers draw without a script or a network."""

import re

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.writers.html5 import HTML5Translator

REWRITTEN = (
    (r"\\(t?frac)\s*(\w)\s*(\w)", r"\\\1{\2}{\3}"),  # \tfrac12
    (r"\\dots|…", r"\\ldots "),
    (r"\\(big|Big)(?=[\[\]()|{}\\])", r"\\\1l"),  # \Big( without a side
    (r"\\(log|det|exp|max|min|tanh)\s*(?=[^\W_]|\\(?!left|big)[a-z])", r"\\\1\\,"),  # the thin space of TeX
)
"""What docutils does not read, and what it reads."""


def rewritten(formula: str, block: bool) -> str:
    """Return a formula that docutils reads; lines of a block without an environment are aligned."""
    for pattern, replacement in REWRITTEN:
        formula = re.sub(pattern, replacement, formula)
    if block and r"\\" in formula and r"\begin" not in formula:
        formula = rf"\begin{{aligned}}{formula}\end{{aligned}}"
    return formula


def mathml(node: nodes.math | nodes.math_block) -> str:
    """Return the MathML of a node."""
    block = isinstance(node, nodes.math_block)
    try:
        return tex2mathml(rewritten(node.astext().strip(), block), as_block=block)
    except (MathError, SyntaxError, AttributeError, IndexError) as error:
        raise ExtensionError(f"{node.source}:{node.line}: {node.astext()!r} cannot be rendered: {error}") from error


def visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula of a line."""
    translator.body.append(mathml(node))
    raise nodes.SkipNode


def visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula of its own."""
    translator.body.append(f'<div class="math">{mathml(node)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
