"""Moving pictures of episodes: truth and estimate, drawn from the first guess on.

A picture is an SVG file with CSS animations, a few ten kB. Browsers whose user wants less motion
show it complete.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from pinnobs_gym.envs.figures import drawn_outputs, jumps, measured_states
from pinnobs_gym.scoring.playing import Played
from pinnobs_gym.scoring.thinning import kept
from pinnobs_gym.simulation.residual import nearest

TRUE, ESTIMATE, MEASURED = "#222222", "#c43d50", "#3f72a6"
WIDTH, PANEL, GAP, LEFT, TOP, BOTTOM = 480, 84, 12, 72, 50, 40
"""Sizes in pixels: of the picture, of a panel and between them, and of the margins."""
POINTS = 240
"""Largest number of points of a line."""
FRAMES = 90
"""Number of places of the present values, between which they move in straight lines."""
SECONDS, HELD, DONE = 9.0, 12, 85
"""Duration of a run, and the percentages of it at which the motion begins and ends."""


@dataclass(frozen=True)
class Panel:
    """The place of one state's panel, and the scale of its axis."""

    top: float
    low: float
    high: float

    def y(self, values: np.ndarray) -> np.ndarray:
        """Return the heights of values in pixels; those beyond the panel are moved to just beyond
        its edge, which clips them."""
        part = (np.asarray(values, dtype=float) - self.low) / (self.high - self.low)
        return self.top + PANEL * (1 - np.clip(part, -0.5, 1.5))


def moving_picture(played: Played, title: str, row: int = 0) -> str:
    """Return an episode as a moving picture: from the start to thrice the end of the transient
    window, in which the estimate finds the true state."""
    system, record = played.system, played.record
    setup = played.game.source.setup
    end = record.t[0] + min(3 * setup.transient_end, setup.duration)
    k = np.flatnonzero(record.t <= end)
    k = k[kept(len(k), POINTS)]
    t, x = record.t[k], played.truth[row, k]
    periods = system.state_period or [None] * system.nx
    xhat = nearest(played.estimates.xhat[row, k], x, system.state_period)
    guess = nearest(record.prior.mean[row][None], x[:1], system.state_period)[0]
    std = None if played.std is None else played.std[row, k]
    y = drawn_outputs(system, x, record.y[row, k])
    across = LEFT + (WIDTH - LEFT - 16) * (t - t[0]) / (t[-1] - t[0])
    panels = [
        _panel(i, np.append(x[:, i], guess[i]), float(system.scale[i])) for i in range(system.nx)
    ]
    parts, styles = [], [_style()]
    for i, (panel, name) in enumerate(zip(panels, system.state_names, strict=True)):
        unit = system.units.get(name)
        parts.append(_frame(i, panel, f"{name} ({unit})" if unit else name))
        drawn = []
        if std is not None:
            drawn.append(_band(across, panel, xhat[:, i], 2 * std[:, i]))
        if i in measured_states(system):
            drawn.append(_dots(across, panel.y(y[:, measured_states(system)[i]])))
        breaks = jumps(x[:, i], periods[i])
        drawn.append(_line(across, panel.y(x[:, i]), breaks, TRUE, 1.6))
        whole = np.append(guess[i], xhat[:, i])  # from the first guess to the first estimate
        breaks = jumps(xhat[:, i], periods[i], x[:, i]) + 1
        drawn.append(
            _line(np.append(across[0], across), panel.y(whole), breaks, ESTIMATE, 1.6, "6 3")
        )
        parts.append(f'<g clip-path="url(#p{i})">{"".join(drawn)}</g>')
    height = panels[-1].top + PANEL
    parts.append(
        f'<g class="cover"><rect x="{LEFT + 0.5}" y="{TOP - 6}" width="{WIDTH - LEFT}" '
        f'height="{height - TOP + 5}" fill="white"/><path d="M{LEFT} {TOP}V{height}" '
        f'stroke="#999"/></g>'
    )
    for i, panel in enumerate(panels):
        parts.append(
            f'<circle cx="{LEFT}" cy="{panel.y(guess[i]):.1f}" r="4.5" fill="none" '
            f'stroke="{ESTIMATE}" stroke-width="1.6"/>'
        )
        for kind, values, first, colour in (
            ("x", x[:, i], x[0, i], TRUE),
            ("e", xhat[:, i], guess[i], ESTIMATE),
        ):
            styles.append(_motion(f"{kind}{i}", across, panel.y(values), float(panel.y(first))))
            parts.append(f'<circle class="dot {kind}{i}" r="3.6" fill="{colour}"/>')
    parts += [_axis(across, t, height, system.time_unit), _legend(title, std is not None)]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height + BOTTOM}" '
        f'font-family="system-ui, sans-serif" font-size="12" role="img">'
        f"<title>{escape(title)}</title><style>{''.join(styles)}</style>"
        f'<rect width="100%" height="100%" fill="white"/>{"".join(parts)}</svg>\n'
    )


def _panel(i: int, seen: np.ndarray, scale: float) -> Panel:
    low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
    margin = 0.12 * (high - low) or 0.1 * scale
    return Panel(TOP + i * (PANEL + GAP), low - margin, high + margin)


def _style() -> str:
    run = f"{SECONDS:g}s linear infinite"
    return (
        f".cover{{animation:c {run}}}.dot{{animation-duration:{SECONDS:g}s;"
        "animation-timing-function:linear;animation-iteration-count:infinite}"
        f"@keyframes c{{0%,{HELD}%{{transform:none}}"
        f"{DONE}%,100%{{transform:translateX({WIDTH - LEFT - 16}px)}}}}"
        "@media (prefers-reduced-motion:reduce){.cover,.dot{display:none}}"
    )


def _motion(name: str, across: np.ndarray, heights: np.ndarray, first: float) -> str:
    """Return the way of a dot along a line, from a first height on, at the speed of the cover."""
    places = np.linspace(across[0], across[-1], FRAMES)
    along = np.interp(places, across, heights)
    percent = np.linspace(HELD, DONE, FRAMES)
    at = [f"0%{{transform:translate({LEFT}px,{first:.1f}px)}}"]
    at += [
        f"{p:.1f}%{{transform:translate({x:.1f}px,{y:.1f}px)}}"
        for p, x, y in zip(percent, places, along, strict=True)
    ]
    at.append(f"100%{{transform:translate({places[-1]:.1f}px,{along[-1]:.1f}px)}}")
    return f".{name}{{animation-name:{name}}}@keyframes {name}{{{''.join(at)}}}"


def _points(across: Iterable[float], heights: Iterable[float]) -> list[str]:
    return [f"{a:.1f} {h:.1f}" for a, h in zip(across, heights, strict=True)]


def _line(
    across: np.ndarray,
    heights: np.ndarray,
    breaks: Sequence[int] | np.ndarray,
    colour: str,
    width: float,
    dash: str = "",
) -> str:
    """Return a line, broken before some of its points and where it is not finite."""
    finite = np.isfinite(heights)
    begins = set(np.asarray(breaks, dtype=int).tolist())
    path, pen = [], False
    for i, point in enumerate(_points(across, heights)):
        if finite[i]:
            path.append(("L" if pen and i not in begins else "M") + point)
        pen = bool(finite[i])
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<path d="{"".join(path)}" fill="none" stroke="{colour}" stroke-width="{width}"{dashed}/>'
    )


def _band(across: np.ndarray, panel: Panel, middle: np.ndarray, half: np.ndarray) -> str:
    known = np.isfinite(middle) & np.isfinite(half)
    if not known.any():
        return ""
    up = _points(across[known], panel.y(middle + half)[known])
    down = _points(across[known], panel.y(middle - half)[known])[::-1]
    return f'<path d="M{"L".join(up + down)}Z" fill="{ESTIMATE}" opacity=".15"/>'


def _dots(across: np.ndarray, heights: np.ndarray) -> str:
    known = np.isfinite(heights)
    points = _points(across[known], heights[known])
    path = "".join(f"M{point}h0" for point in points)
    return f'<path d="{path}" stroke="{MEASURED}" stroke-width="3" stroke-linecap="round"/>'


def _frame(i: int, panel: Panel, name: str) -> str:
    """Return a panel's frame, its clip path, its name and the numbers at its axis."""
    box = f'x="{LEFT}" y="{panel.top}" width="{WIDTH - LEFT - 16}" height="{PANEL}"'
    middle = panel.top + PANEL / 2
    marks = "".join(
        f'<text x="{LEFT - 6}" y="{panel.y(np.asarray(value)) + 4:.1f}" text-anchor="end" '
        f'font-size="10" fill="#555">{value:.3g}</text>'
        for value in _ticks(panel.low, panel.high)
    )
    return (
        f'<clipPath id="p{i}"><rect {box}/></clipPath>'
        f'<rect {box} fill="#fff" stroke="#ccc"/>{marks}'
        f'<text transform="translate(16 {middle}) rotate(-90)" text-anchor="middle">'
        f"{escape(name)}</text>"
    )


def _ticks(low: float, high: float) -> list[float]:
    """Return two to five round numbers in a range."""
    unit = 10 ** np.floor(np.log10((high - low) / 5))
    step = next(unit * f for f in (1, 2, 5, 10) if (high - low) / (unit * f) < 5)
    return (np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step + 0.0).tolist()


def _axis(across: np.ndarray, t: np.ndarray, height: float, unit: str) -> str:
    marks = "".join(
        f'<text x="{np.interp(value, t, across):.1f}" y="{height + 15}" text-anchor="middle" '
        f'font-size="10" fill="#555">{value:.3g}</text>'
        for value in _ticks(float(t[0]), float(t[-1]))
    )
    middle = (LEFT + WIDTH) / 2
    return f'{marks}<text x="{middle}" y="{height + 32}" text-anchor="middle">t ({unit})</text>'


def _legend(title: str, band: bool) -> str:
    key = (
        f'<tspan fill="{TRUE}">— true</tspan>'
        f'<tspan fill="{ESTIMATE}" dx="10">- - estimate{", ±2σ" if band else ""}</tspan>'
        f'<tspan fill="{ESTIMATE}" dx="10">○ first guess</tspan>'
        f'<tspan fill="{MEASURED}" dx="10">• measured</tspan>'
    )
    return (
        f'<text x="{LEFT}" y="18" font-weight="600">{escape(title)}</text>'
        f'<text x="{LEFT}" y="37">{key}</text>'
    )
