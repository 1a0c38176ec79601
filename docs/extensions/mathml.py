"""Formulas as MathML, made while the site is built: browsers need no script and no fonts for it."""

from __future__ import annotations

import html
import re
from typing import TYPE_CHECKING

from docutils import nodes
from latex2mathml.converter import convert

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator


def inline(writer: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line."""
    writer.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula of its own, with its number where it has a label."""
    number = ""
    if node.get("number"):
        writer.add_permalink_ref(node, "Link to this equation")
        number = f'<span class="eqno">({html.escape(str(node["number"]))})</span>'
    source = re.sub(r"\n\s*\n", "\n", node.astext())
    writer.body.append(
        writer.starttag(node, "div", CLASS="math-block")
        + number
        + convert(source, display="block")
        + "</div>\n"
    )
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer with Sphinx."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
