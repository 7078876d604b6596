"""Figures with panels at fixed places.

Margins are given in inches and fit numbers, names and titles of usual length. Matplotlib's own
layouts measure all texts instead, which takes as long as all the drawing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEFT = 1.1
"""Width in inches of numbers as long as −0.00025 and of an axis's name, beside a panel."""
BELOW = 0.55
"""Height in inches of the numbers and the name under a panel."""
ABOVE = 0.35
"""Height in inches of a title."""


def panels(
    rows: int,
    columns: int = 1,
    *,
    width: float,
    height: float,
    beside: float = LEFT,
    after: float = 0.25,
    between: float = 0.12,
) -> tuple[Figure, Any]:
    """Return a figure and its panels, an array (rows, columns) of axes.

    Args:
        rows: number of rows; those of one column have their numbers under the last row alone.
        columns: number of columns.
        width: of the figure, in inches.
        height: of the figure, in inches.
        beside: width between two columns, in inches.
        after: width beside the last column, in inches; half a number stands over its edge.
        between: height between two rows, in inches.
    """
    from matplotlib.figure import Figure

    across = (width - LEFT - after - (columns - 1) * beside) / columns
    up = (height - BELOW - ABOVE - (rows - 1) * between) / rows
    places = {
        "left": LEFT / width,
        "right": 1 - after / width,
        "bottom": BELOW / height,
        "top": 1 - ABOVE / height,
        "wspace": beside / across,
        "hspace": between / up,
    }
    figure = Figure(figsize=(width, height))
    shared = columns == 1
    return figure, figure.subplots(rows, columns, sharex=shared, squeeze=False, gridspec_kw=places)
