"""Charts over time: errors, settling, and the states of one episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import altair as alt

from pinnobs_gym.leaderboard.display import one_line
from pinnobs_gym.leaderboard.site.charts import (
    NAME,
    SHOWN,
    Spec,
    Styled,
    exact,
    finished,
    finite,
    log_axis,
    log_scale,
    named,
    time_of,
)

HEIGHT = 300
"""Height of a chart over time, in pixels."""


def _floor(base: alt.Chart, **line: Any) -> list[alt.Chart]:
    """Return the lines of the floors: grey, and dashed where the whole record is known."""
    whole = "indexof(datum.name, 'whole record') >= 0"
    return [
        base.transform_filter(f"!({whole})").mark_line(style="floor", **line),
        base.transform_filter(whole).mark_line(style="floor", strokeDash=[7, 4], **line),
    ]


def errors(styled: Styled, end: float, low: float, high: float) -> Spec:
    """Chart the error over time up to ``end`` (s), on an axis from low to high: medians and bands
    of the selected estimators, over the medians of all others, the floor and the Cramér-Rao
    reference."""
    scale, axis = log_scale(low, high), log_axis(low, high)
    y = alt.Y("shown_median:Q", scale=scale, title="NRMSE of a sample", axis=axis)
    base = (
        named("errors")
        .transform_calculate(
            shown_median="datum.median > 0 ? datum.median : null",
            low="datum.q10 > 0 ? datum.q10 : null",
            high=finite("q90"),
        )
        .encode(x=time_of(end), y=y)
    )
    chosen = base.transform_filter(SHOWN)
    reference = (
        named("reference")
        .transform_calculate(shown_median="datum.median > 0 ? datum.median : null")
        .encode(x=time_of(end), y=y)
    )
    floor = (
        named("floor_errors")
        .transform_calculate(shown_median="datum.median > 0 ? datum.median : null")
        .encode(x=time_of(end), y=y, detail="estimator:N")
    )
    tips = [NAME, exact("t", "t (s)"), exact("median"), exact("q10", "10 %")]
    return finished(
        base.transform_filter(f"!({SHOWN})")
        .mark_line(style="others", clip=True)
        .encode(detail="estimator:N"),
        *_floor(floor, clip=True),
        chosen.mark_area(opacity=0.11, clip=True).encode(
            y=alt.Y("low:Q", scale=scale), y2="high:Q", color=styled.colour
        ),
        chosen.mark_line(clip=True).encode(color=styled.colour, strokeDash=styled.dash),
        reference.mark_line(style="reference", clip=True),
        floor.mark_point(opacity=0, size=90, filled=True, clip=True).encode(tooltip=tips[:3]),
        chosen.mark_point(opacity=0, size=90, filled=True, clip=True).encode(
            color=styled.colour, tooltip=[*tips, exact("q90", "90 %")]
        ),
        height=HEIGHT,
        shown=[],
    )


def settling(styled: Styled, end: float) -> Spec:
    """Chart the share of settled episodes against time up to ``end`` (s), also of the floor."""
    axis = alt.Axis(format="%", values=[0, 0.25, 0.5, 0.75, 1])
    y = alt.Y("share:Q", scale=alt.Scale(domain=[0, 1]), title="episodes settled", axis=axis)
    base = named("settling").encode(x=time_of(end), y=y)
    chosen = base.transform_filter(SHOWN).encode(color=styled.colour)
    floor = named("floor_settling").encode(x=time_of(end), y=y, detail="estimator:N")
    tips = [NAME, exact("t", "t (s)"), alt.Tooltip("share:Q", format=".0%")]
    return finished(
        base.transform_filter(f"!({SHOWN})")
        .mark_line(style="others", interpolate="step-after")
        .encode(detail="estimator:N"),
        *_floor(floor, interpolate="step-after"),
        floor.mark_point(opacity=0, size=90, filled=True).encode(tooltip=tips),
        chosen.mark_line(interpolate="step-after").encode(strokeDash=styled.dash),
        chosen.mark_point(opacity=0, size=90, filled=True).encode(tooltip=tips),
        height=HEIGHT,
        shown=[],
    )


def error(styled: Styled, index: int, end: float, limits: Sequence[float]) -> Spec:
    """Chart the error of the selected estimator in one state of the example episode, with twice
    its standard deviation about zero. The page can set the end (s) of the time axis.

    Args:
        styled: the styles.
        index: the state.
        end: the end of the time axis in s.
        limits: of each estimator in the order of the styles, the largest error on its axis.
    """
    scale = alt.Scale(
        domainMin=alt.ExprRef(expr="-limits[selected]"),
        domainMax=alt.ExprRef(expr="limits[selected]"),
        nice=False,
        clamp=True,
    )
    until = alt.Scale(domainMin=0, domainMax=alt.ExprRef(expr="until"), nice=False)
    x = alt.X("t:Q", scale=until, axis=alt.Axis(tickCount=6, labels=False), title=None)

    def y(field: str) -> alt.Y:
        axis = alt.Axis(tickCount=3, format="~g")
        return alt.Y(f"{field}:Q", scale=scale, title="error", axis=axis)

    mine = (
        named("estimates")
        .transform_filter("datum.estimator === selected")
        .transform_calculate(
            low=f"isValid(datum.s{index}) ? -datum.s{index} : null",
            high=f"isValid(datum.s{index}) ? datum.s{index} : null",
        )
        .encode(x=x, color=styled.colour)
    )
    zero = named("one").transform_calculate(zero="0").mark_rule(style="level")
    return finished(
        mine.mark_area(opacity=0.18, clip=True).encode(y=y("low"), y2="high:Q"),
        zero.encode(y=y("zero")),
        mine.mark_line(clip=True).encode(y=y(f"e{index}")),
        height=70,
        selected=-1,
        until=end,
        limits=list(limits),
    )


def state(
    styled: Styled,
    index: int,
    title: str,
    end: float,
    limits: tuple[float, float],
    measured: bool,
    in_part: bool = False,
) -> Spec:
    """Chart one state of the example episode within its limits, with the selected estimator's
    estimate. Dots are an output that directly measures the state; dark dots the true state if it is
    known in part. The page can set the end (s) of the time axis."""
    scale = alt.Scale(domain=list(limits), nice=False, clamp=True)
    until = alt.Scale(domainMin=0, domainMax=alt.ExprRef(expr="until"), nice=False)
    x = alt.X("t:Q", scale=until, axis=alt.Axis(tickCount=6), title="t (s)")
    truth = named("truth").encode(x=x)
    mine = (
        named("estimates")
        .transform_filter("datum.estimator === selected")
        .transform_calculate(
            low=f"isValid(datum.s{index}) ? datum.m{index} - datum.s{index} : null",
            high=f"isValid(datum.s{index}) ? datum.m{index} + datum.s{index} : null",
        )
        .encode(x=x, color=styled.colour)
    )

    def y(field: str) -> alt.Y:
        return alt.Y(f"{field}:Q", scale=scale, title=one_line(title), axis=alt.Axis(tickCount=4))

    layers = [
        mine.mark_area(opacity=0.18, clip=True).encode(y=y("low"), y2="high:Q"),
        mine.mark_line(strokeDash=[5, 3], clip=True).encode(y=y(f"m{index}")),
    ]
    if in_part:
        known = truth.transform_filter(f"isValid(datum.x{index})")
        layers.append(known.mark_point(style="reference_state", clip=True).encode(y=y(f"x{index}")))
    else:
        layers.insert(1, truth.mark_line(style="truth", clip=True).encode(y=y(f"x{index}")))
    if measured:
        layers.insert(0, truth.mark_point(style="measured", clip=True).encode(y=y(f"y{index}")))
    return finished(*layers, height=120, selected=-1, until=end)
