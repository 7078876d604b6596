"""Colours, dashes and symbols of estimators, the same in every chart of a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

LIGHT = ("#0072b2", "#d55e00", "#009e73", "#b8559a", "#c78500", "#3d9bd6", "#7a5230")
DARK = ("#4aa8e0", "#ff8a3d", "#2fc79b", "#e08ec4", "#f2b733", "#9ad4ff", "#c9a27e")
"""Colours after Okabe & Ito, distinguishable by colour-blind readers, for light and dark
backgrounds; similar hues differ in lightness."""
PEER_COLOURS = ("#3b4048", "#d7dbe0")
"""Colours of the peer on light and dark backgrounds."""
DASHES = ((1, 0), (6, 3), (2, 2), (9, 3, 2, 3))
"""Lengths of dashes and gaps, in pixels."""
SHAPES = ("circle", "square", "triangle-up", "diamond")
"""With `DASHES`, these distinguish the second, third and fourth use of the colours from the
first."""


@dataclass(frozen=True)
class Style:
    """The style of one estimator."""

    light: str
    dark: str
    dash: tuple[int, ...]
    shape: str


def styles(names: Sequence[str], peer: str) -> dict[str, Style]:
    """Return the style of each estimator, with the peer in `PEER_COLOURS`; styles repeat after
    `SHAPES` rounds of the colours."""
    assigned = {}
    place = 0
    for name in names:
        if name == peer:
            assigned[name] = Style(*PEER_COLOURS, DASHES[0], SHAPES[0])
            continue
        turn, hue = divmod(place, len(LIGHT))
        turn %= len(SHAPES)
        assigned[name] = Style(LIGHT[hue], DARK[hue], DASHES[turn], SHAPES[turn])
        place += 1
    return assigned
