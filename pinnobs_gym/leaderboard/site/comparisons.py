"""Charts that compare estimators with the peer, with the reference, and by cost."""

from __future__ import annotations

from collections.abc import Sequence

import altair as alt

from pinnobs_gym.leaderboard.site.charts import (
    NAME,
    Spec,
    Styled,
    exact,
    finished,
    finite,
    log_axis,
    log_scale,
    named,
)

STEP = 21
"""Height of a line, in pixels, in charts with one line per estimator."""
TALL_STEP = 27
"""The same of lines with two symbols, one below the other."""
NAMES = 150
"""Largest width of a name in a chart, in pixels; longer ones end with an ellipsis."""
PLAIN_NAMES = alt.Axis(
    domain=False,
    ticks=False,
    grid=False,
    labelExpr="names[datum.value]",
    labelLimit=NAMES,
    labelPadding=8,
    minExtent=0,
)
"""The estimator axis of charts with one line per estimator; the page sets ``names``."""


def lines_of(styled: Styled, order: Sequence[str]) -> alt.Y:
    """Return the axis with a line for each estimator, in this order."""
    places = [styled.places[name] for name in order]
    return alt.Y("estimator:N", sort=places, title=None, axis=PLAIN_NAMES)


def level(scale: alt.Scale, vertical: bool) -> alt.Chart:
    """Return a line at ratio 1."""
    rule = named("one").mark_rule(style="level")
    if vertical:
        return rule.encode(x=alt.XDatum(1, scale=scale))
    return rule.encode(y=alt.YDatum(1, scale=scale))


def factors(styled: Styled, order: Sequence[str], low: float, high: float) -> Spec:
    """Chart the factor to the peer with its interval, a line per estimator, on an axis from low to
    high."""
    scale = log_scale(low, high)
    tips = [
        NAME,
        "track:N",
        exact("ratio", "ratio to the peer"),
        exact("low"),
        exact("high"),
    ]
    title = f"steady NRMSE / {styled.peer}'s"
    x = alt.X("ratio:Q", scale=scale, title=title, axis=log_axis(low, high))
    base = (
        named("standings")
        .transform_calculate(upper=finite("high"))
        .encode(
            y=lines_of(styled, order),
            color=styled.colour,
            tooltip=tips,
        )
    )
    return finished(
        level(scale, vertical=True),
        base.mark_rule(strokeWidth=2).encode(x=alt.X("low:Q", scale=scale), x2="upper:Q"),
        base.mark_point(filled=True, size=70, opacity=1).encode(x=x, shape=styled.shape),
        height=STEP * len(order),
        names=[],
    )


def ratios(styled: Styled, order: Sequence[str], low: float, high: float) -> Spec:
    """Chart quantiles of the error over the Cramér-Rao reference, a line per estimator, on an axis
    from low to high."""
    scale, axis = log_scale(low, high), log_axis(low, high)
    title = "steady NRMSE / reference"
    base = (
        named("ratios")
        .transform_calculate(upper90=finite("q90"), upper75=finite("q75"))
        .encode(
            y=lines_of(styled, order),
            tooltip=[NAME, *map(exact, ("q10", "q25", "rms", "q75", "q90"))],
        )
    )
    coloured = base.encode(color=styled.colour)
    return finished(
        level(scale, vertical=True),
        coloured.mark_rule(strokeWidth=1.5).encode(
            x=alt.X("q10:Q", scale=scale, axis=axis, title=title), x2="upper90:Q"
        ),
        coloured.mark_bar(size=9, opacity=0.6).encode(
            x=alt.X("q25:Q", scale=scale, axis=axis, title=title), x2="upper75:Q"
        ),
        base.transform_filter("isValid(datum.rms)")
        .mark_tick(style="middle")
        .encode(x=alt.X("rms:Q", scale=scale, axis=axis, title=title)),
        height=STEP * len(order),
        names=[],
    )


def over_floor(styled: Styled, order: Sequence[str], low: float, high: float) -> Spec:
    """Chart errors over the floor with their intervals, a line per estimator, on an axis from low
    to high: a filled symbol in the steady window, and below it a hollow one in the transient."""
    scale, axis = log_scale(low, high), log_axis(low, high)
    x = alt.X("shown:Q", scale=scale, axis=axis, title="RMS error / the floor's")
    base = (
        named("over_floor")
        .transform_calculate(shown=finite("ratio"), lower=finite("low"), upper=finite("high"))
        .encode(
            y=lines_of(styled, order),
            color=styled.colour,
            tooltip=[NAME, "window:N", *map(exact, ("ratio", "low", "high"))],
        )
    )
    layers = [level(scale, vertical=True)]
    for window, offset, filled in (("steady", -4, True), ("transient", 5, False)):
        own = base.transform_filter(f"datum.window === '{window}'")
        layers += [
            own.mark_rule(strokeWidth=2 if filled else 1, yOffset=offset).encode(
                x=alt.X("lower:Q", scale=scale, axis=axis), x2="upper:Q"
            ),
            own.mark_point(filled=filled, size=55, opacity=1, yOffset=offset).encode(
                x=x, shape=styled.shape
            ),
        ]
    return finished(*layers, height=TALL_STEP * len(order), names=[])


def cost(
    styled: Styled,
    field: str,
    title: str,
    across: tuple[float, float],
    up: tuple[float, float],
) -> Spec:
    """Chart the factor to the peer against a cost, with the ranges of both axes. Points with a true
    ``named_<field>`` are labelled."""
    scale = log_scale(*up)
    x = alt.X(f"{field}:Q", scale=log_scale(*across), title=title, axis=log_axis(*across))
    y = alt.Y("ratio:Q", scale=scale, title=f"steady NRMSE / {styled.peer}'s", axis=log_axis(*up))
    tips = [NAME, "track:N", exact(field, title), exact("ratio", "ratio to the peer")]
    base = (
        named("standings")
        .transform_filter(f"isValid(datum.{field})")
        .transform_calculate(upper=finite("high"))
        .encode(x=x, y=y, tooltip=[*tips, exact("low"), exact("high")])
    )
    labels = base.transform_filter(f"datum.named_{field}").encode(text="name:N")
    room = alt.expr(f"max(30, min({NAMES}, width - scale('x', datum.{field}) - 8))")
    text = {"align": "left", "dx": 8, "dy": -7, "limit": room}  # names end within the chart
    return finished(
        level(scale, vertical=False),
        base.mark_rule(opacity=0.5).encode(
            y=alt.Y("low:Q", scale=scale), y2="upper:Q", color=styled.colour
        ),
        base.mark_point(filled=True, size=80, opacity=1).encode(
            color=styled.colour, shape=styled.shape
        ),
        labels.mark_text(style="name_ground", **text),  # so that symbols do not strike through
        labels.mark_text(style="name", **text),
        height=340,
    )
