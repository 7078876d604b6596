"""Equations as MathML, which browsers draw without a script and without a network.

docutils converts them when the pages are built; a command that it does not know is an error of the
build.
"""

from __future__ import annotations

import re
from html import unescape
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

_IN_TEXT_SIZE = re.compile(r"\\textstyle\s*(\\[A-Za-z]+)")
"""A sign in the size of the text, which docutils takes only at the beginning of a group."""
_DIGITS = re.compile(r"\\([td]?frac)(\d)(\d)")
"""A fraction of two digits without braces, which docutils takes for a number over what follows."""
_ACCENTS = "ˆ˙¨ˉ˜~¯"
_BARS = ("‖", "∥", "|")


def mathml(latex: str, block: bool) -> str:
    """Return an equation in LaTeX, inline or as a block, as MathML.

    Raises:
        docutils.utils.math.MathError: naming what is not known.
    """
    latex = _DIGITS.sub(r"\\\1{\2}{\3}", latex)
    made = tex2mathml(_IN_TEXT_SIZE.sub(r"{\\textstyle \1}", latex), as_block=block)
    made = made.replace(' xmlns="http://www.w3.org/1998/Math/MathML"', "")
    named = re.compile(r"&(?!lt;|gt;|amp;|quot;)\w+;")  # names of signs that XML has not
    tree = ElementTree.fromstring(named.sub(lambda each: unescape(each[0]), made))
    _place_indices(tree)
    for node in tree.iter("mtext"):  # in which docutils leaves escapes as they are
        text = re.sub(r"\\([_&%$#{}])", r"\1", node.text or "")
        node.text = text.replace(" ", "\N{NO-BREAK SPACE}")  # or a narrow cell breaks the line
    pairs = [end for row in tree.iter("mrow") for end in (row[:1] + row[-1:]) if _is_pair(row)]
    for node in tree.iter("mo"):
        # Both bars are of one size, also where the closing one is the base of an index.
        if node.text in _BARS and "minsize" not in node.attrib and node not in pairs:
            node.set("stretchy", "false")
    return ElementTree.tostring(tree, encoding="unicode", short_empty_elements=False)


def _is_pair(row: ElementTree.Element) -> bool:
    """Return whether the ends of a row are bars that grow with what is between."""
    return len(row) > 2 and row[0].text in _BARS and row[-1].text in _BARS


def _place_indices(node: ElementTree.Element) -> None:
    """Set the index of a sign with an accent beside it; docutils sets it below."""
    for child in node:
        _place_indices(child)
    parts = list(node)
    if node.tag == "munderover" and (parts[2].text or "") in _ACCENTS:
        base, index, accent = parts
        accented = ElementTree.Element("mover", {"accent": "true"})
        accented.extend([base, accent])
        node.tag, node[:] = "msub", [accented, index]
    elif node.tag == "msup" and parts[0].tag == "msub":
        node.tag, node[:] = "msubsup", [*parts[0], parts[1]]


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(f'<span class="math">{mathml(node.astext(), block=False)}</span>')
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math">{mathml(node.astext(), block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
