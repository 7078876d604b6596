"""Short cells of tables get a class, so that their numbers are not broken on a phone."""

from __future__ import annotations

from typing import Any

from docutils import nodes

LONGEST = 22
"""Most characters of a short cell: a number with its interval."""


def mark(app: Any, document: nodes.document) -> None:
    """Give the cells of table bodies with few characters the class ``short``."""
    for body in document.findall(nodes.tbody):
        for cell in body.findall(nodes.entry):
            if len(cell.astext()) <= LONGEST:
                cell["classes"].append("short")
