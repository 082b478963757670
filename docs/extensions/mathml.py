"""Formulas as MathML, which every browser draws without a script from the network.

Sphinx's own renderers need a script from the network (MathJax) or a LaTeX installation (imgmath);
docutils turns the LaTeX of a formula into MathML by itself.
"""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.math import get_node_equation_number


def to_mathml(source: str, *, block: bool) -> str:
    """Convert a formula to MathML.

    Raises:
        ExtensionError: docutils cannot parse the formula, or would misread it.
    """
    if re.search(r"frac\s*\d", source):  # docutils takes 12 for the numerator of \frac12
        raise ExtensionError(f"write fractions with braces: {source!r}")
    try:
        made = latex2mathml.tex2mathml(source, as_block=block)
        return made.replace("<mo>&ApplyFunction;</mo>", '<mspace width="0.17em"/>')  # log x
    except Exception as error:
        raise ExtensionError(f"this formula cannot be turned into MathML: {source!r}") from error


def visit_inline(self: Any, node: nodes.math) -> None:
    """Write a formula within a line."""
    self.body.append(to_mathml(node.astext(), block=False))
    raise nodes.SkipNode


def visit_block(self: Any, node: nodes.math_block) -> None:
    """Write a formula on a line of its own, with its number if it has one."""
    self.body.append(self.starttag(node, "div", CLASS="math"))
    if node["number"]:
        number = get_node_equation_number(self, node)
        self.body.append(f'<span class="eqno">({number})</span>')
    self.body.append(to_mathml(node.astext(), block=True) + "</div>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer as `mathml`."""
    app.add_html_math_renderer(
        "mathml", inline_renderers=(visit_inline, None), block_renderers=(visit_block, None)
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}
