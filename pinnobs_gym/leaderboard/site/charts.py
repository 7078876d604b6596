"""What the page's charts share. They are Vega-Lite made with Altair; their data are named and come
with the page, and the theme has the colours: of estimators, of the ground, and of each `style`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import altair as alt
import numpy as np

from pinnobs_gym.leaderboard.site.palette import Style

Spec = dict[str, Any]
"""A chart in Vega-Lite."""
SHOWN = "indexof(shown, datum.estimator) >= 0"
"""Whether the reader has chosen the estimator."""
PLAIN = ".3~r"
"""How ticks are written: without exponents."""
HUGE = 1e9
"""Stands for infinity, beyond every axis."""


class Styled:
    """Encodings that draw each estimator as its style says."""

    def __init__(self, styles: Mapping[str, Style]) -> None:
        names = list(styles)
        dashes = [list(style.dash) for style in styles.values()]
        shapes = [style.shape for style in styles.values()]
        field = "estimator:N"
        self.colour = alt.Color(field, scale=alt.Scale(domain=names), legend=None)
        self.dash = alt.StrokeDash(field, scale=alt.Scale(domain=names, range=dashes), legend=None)
        self.shape = alt.Shape(field, scale=alt.Scale(domain=names, range=shapes), legend=None)


def named(data: str) -> alt.Chart:
    """A chart of data that the page has under that name."""
    return alt.Chart(alt.NamedData(name=data))


def finished(*layers: Any, height: int, **params: Any) -> Spec:
    """Layers as one chart as wide as its place; ``params`` can be set by the page."""
    spec = alt.layer(*layers).to_dict(validate=False)  # the tests do that; it takes long
    spec.pop("config", None)
    own = [{"name": name, "value": value} for name, value in params.items()]
    spec |= {"width": "container", "height": height, "params": own}
    return spec


def log_scale(low: float, high: float) -> alt.Scale:
    """A logarithmic scale; what is beyond it is drawn at its end."""
    return alt.Scale(type="log", domain=[low, high], clamp=True, nice=False)


def log_axis(low: float, high: float) -> alt.Axis:
    """Ticks at 1, 2, 5, 10, ...; more within less than a decade, powers of ten over many."""
    decades = np.log10(high / low)
    parts: tuple[float, ...] = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if decades < 0.8 else (1, 2, 5)
    if decades >= 1.6:
        parts = (1, 3) if decades < 3 else (1,)
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    ticks = [float(f"{part}e{power}") for power in range(first, last + 1) for part in parts]
    inside = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
    return alt.Axis(values=inside, format=PLAIN, labelOverlap=True)


def time_of(end: float) -> alt.X:
    """The time axis up to ``end`` (s): linear at first, then logarithmic, so that the transient is
    seen. It ends at a tick if one is near."""
    powers = range(int(np.floor(np.log10(end / 200))), int(np.ceil(np.log10(end))) + 1)
    ticks = [float(f"{part}e{power}") for power in powers for part in (1, 2, 5)]
    values = [0.0, *(tick for tick in ticks if end / 200 <= tick <= 1.02 * end)]
    end = max(end, values[-1])
    scale = alt.Scale(type="symlog", constant=end / 200, domain=[0, end], nice=False)
    axis = alt.Axis(values=values, format=PLAIN, labelOverlap="greedy", labelFlush=True)
    return alt.X("t:Q", scale=scale, axis=axis, title="t (s)")


def exact(field: str, title: str = "") -> alt.Tooltip:
    """A number in the box that the pointer opens."""
    return alt.Tooltip(f"{field}:Q", format=".3~g", title=title or field)


def finite(field: str) -> str:
    """An expression that is beyond every axis where the field has a gap."""
    return f"isValid(datum.{field}) ? datum.{field} : {HUGE}"


def nice_range(values: Sequence[float | None], low: float, high: float) -> tuple[float, float]:
    """What a logarithmic axis of these values shows, a margin around them, within low and high."""
    known = [value for value in values if value is not None and value > 0]
    if not known:
        return low, high
    return max(min(known) / 1.25, low), min(max(known) * 1.25, high)
