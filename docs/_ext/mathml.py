"""Formulas as MathML, which browsers draw themselves: no script, and nothing from the network."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

LOGGER = logging.getLogger(__name__)


_WITHOUT_BRACES = re.compile(r"frac\s*\d")  # \tfrac12 would become the number 12
_ACCENT_AND_INDEX = re.compile(
    r"<munderover>\s*(?P<base><m[in]>[^<]*</m[in]>)\s*(?P<index><(m\w+)[^>]*>.*?</\3>)\s*"
    r'(?P<accent><mo stretchy="false">[^<]*</mo>)\s*</munderover>',
    re.DOTALL,
)
"""A letter with an accent and an index, which docutils puts below the letter."""


def mathml(formula: str, as_block: bool) -> str:
    """Return a formula of LaTeX as MathML.

    Raises
    ------
    MathError
        For what cannot be converted.
    """
    if _WITHOUT_BRACES.search(formula):
        raise MathError("give the numbers of a fraction in braces")
    made = tex2mathml(formula, as_block=as_block)
    return _ACCENT_AND_INDEX.sub(r'<msub><mover accent="true">\g<base>\g<accent></mover>\g<index></msub>', made)


def _mathml(node: nodes.Element, as_block: bool) -> str:
    try:
        return mathml(node.astext(), as_block)
    except MathError as error:
        LOGGER.warning("formula %r: %s", node.astext(), error, location=node)
        return ""


def _inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node, as_block=False))
    raise nodes.SkipNode


def _block(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math-block">{_mathml(node, as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
