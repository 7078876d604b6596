"""Colours, dashes and marks of estimators: the same in every chart of a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pinnobs_gym.leaderboard.contenders import PEER

LIGHT = ("#0072b2", "#d55e00", "#009e73", "#b8559a", "#c78500", "#3d9bd6", "#7a5230")
DARK = ("#4aa8e0", "#ff8a3d", "#2fc79b", "#e08ec4", "#f2b733", "#9ad4ff", "#c9a27e")
"""Hues after Okabe & Ito, which the colour-blind tell apart, as light or dark as the ground
asks; those that look alike to some differ in lightness."""
PEER_COLOURS = ("#3b4048", "#d7dbe0")
"""Of the estimator that all are compared with, in light and in the dark."""
DASHES = ((1, 0), (6, 3), (2, 2), (9, 3, 2, 3))
"""Lengths of strokes and gaps, in pixels."""
SHAPES = ("circle", "square", "triangle-up", "diamond")
"""These and `DASHES` tell the second, third and fourth round of the hues from the first."""


@dataclass(frozen=True)
class Style:
    """How one estimator is drawn."""

    light: str
    dark: str
    dash: tuple[int, ...]
    shape: str


def styles(names: Sequence[str]) -> dict[str, Style]:
    """The style of each estimator; beyond `SHAPES` rounds of hues they repeat."""
    found = {}
    place = 0
    for name in names:
        if name == PEER:
            found[name] = Style(*PEER_COLOURS, DASHES[0], SHAPES[0])
            continue
        turn, hue = divmod(place, len(LIGHT))
        turn %= len(SHAPES)
        found[name] = Style(LIGHT[hue], DARK[hue], DASHES[turn], SHAPES[turn])
        place += 1
    return found
