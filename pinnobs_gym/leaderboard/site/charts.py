"""Common parts of the page's charts. They are Vega-Lite made with Altair; their data are named and
embedded in the page, and the page's theme sets the colours of estimators, background and each
`style`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import altair as alt
import numpy as np

from pinnobs_gym.leaderboard.display import one_line
from pinnobs_gym.leaderboard.site.palette import Style

Spec = dict[str, Any]
"""A chart in Vega-Lite."""
SHOWN = "indexof(shown, datum.estimator) >= 0"
"""Expression for whether the reader has selected the estimator."""
NAME = alt.Tooltip("name:N", title="estimator")
"""The estimator in a tooltip."""
PLAIN = ".3~r"
"""Number format of ticks, without exponents."""
AXIS = 54
"""Height of the horizontal axis with its title and of the padding, in pixels."""
HUGE = 1e9
"""Replaces infinity, beyond every axis."""


class Styled:
    """Encodings that draw each estimator in its style, and the name of the peer, over whose errors
    factors are. In the data, and thus in a chart's code, an estimator is its place among
    ``styles``: names are text that anybody may have written, and are looked up where they are
    drawn."""

    def __init__(self, styles: Mapping[str, Style], peer: str) -> None:
        self.peer = one_line(peer)
        self.places = {name: i for i, name in enumerate(styles)}
        """Place of each estimator."""
        domain = list(self.places.values())
        dashes = [list(style.dash) for style in styles.values()]
        shapes = [style.shape for style in styles.values()]
        field = "estimator:N"
        self.colour = alt.Color(field, scale=alt.Scale(domain=domain), legend=None)
        self.dash = alt.StrokeDash(field, scale=alt.Scale(domain=domain, range=dashes), legend=None)
        self.shape = alt.Shape(field, scale=alt.Scale(domain=domain, range=shapes), legend=None)


def named(data: str) -> alt.Chart:
    """Return a chart of the page's data of that name."""
    return alt.Chart(alt.NamedData(name=data))


def finished(*layers: Any, height: int, **params: Any) -> Spec:
    """Combine layers into one chart as wide as its container, ``height`` pixels high and `AXIS`
    more for its axis; ``params`` can be set by the page."""
    spec = alt.layer(*layers).to_dict(validate=False)  # the tests do that; it takes long
    spec.pop("config", None)
    own = [{"name": name, "value": value} for name, value in params.items()]
    # The chart takes exactly the height that the page keeps for it, so that nothing below moves
    # when it is drawn.
    fit = {"type": "fit", "contains": "padding"}
    spec |= {"width": "container", "height": height + AXIS, "autosize": fit, "params": own}
    return spec


def log_scale(low: float, high: float) -> alt.Scale:
    """Return a logarithmic scale; values beyond it are drawn at its end."""
    return alt.Scale(type="log", domain=[low, high], clamp=True, nice=False)


def log_axis(low: float, high: float) -> alt.Axis:
    """Return an axis with ticks at 1, 2, 5, 10, ...; with more below a decade, and powers of ten
    over many decades."""
    decades = np.log10(high / low)
    parts: tuple[float, ...] = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if decades < 0.8 else (1, 2, 5)
    if decades >= 1.6:
        parts = (1, 3) if decades < 3 else (1,)
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    ticks = [float(f"{part}e{power}") for power in range(first, last + 1) for part in parts]
    inside = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
    return alt.Axis(values=inside, format=PLAIN, labelOverlap=True)


def time_of(end: float) -> alt.X:
    """Return the time axis up to ``end`` (s): linear at first, then logarithmic, to resolve the
    transient. It ends at a tick if one is near."""
    powers = range(int(np.floor(np.log10(end / 200))), int(np.ceil(np.log10(end))) + 1)
    ticks = [float(f"{part}e{power}") for power in powers for part in (1, 2, 5)]
    values = [0.0, *(tick for tick in ticks if end / 200 <= tick <= 1.02 * end)]
    end = max(end, values[-1])
    scale = alt.Scale(type="symlog", constant=end / 200, domain=[0, end], nice=False)
    axis = alt.Axis(values=values, format=PLAIN, labelOverlap="greedy", labelFlush=True)
    return alt.X("t:Q", scale=scale, axis=axis, title="t (s)")


def exact(field: str, title: str = "") -> alt.Tooltip:
    """Return a number in the tooltip, in three digits."""
    return alt.Tooltip(f"{field}:Q", format=".3~g", title=title or field)


def finite(field: str) -> str:
    """Return an expression with a value beyond every axis where the field has a gap."""
    return f"isValid(datum.{field}) ? datum.{field} : {HUGE}"


def nice_range(values: Sequence[float | None], low: float, high: float) -> tuple[float, float]:
    """Return the range of a logarithmic axis of these values with a margin, within low and high."""
    known = [value for value in values if value is not None and value > 0]
    if not known:
        return low, high
    return max(min(known) / 1.25, low), min(max(known) * 1.25, high)
