"""Figures of true states and their estimates, for env frames, TensorBoard and files."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.envs.panels import panels
from pinnobs_gym.simulation.residual import nearest, residual
from pinnobs_gym.simulation.system import System, initial_states

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRUE, ESTIMATE, MEASURED = "#222222", "#d1495b", "#9bb7d4"
"""Colours of true states, estimates and measured outputs."""
_ROUNDING = 1e-9
"""Largest difference, over its period, of an angle and an output that measures it."""
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")
"""Environment variables of which one is set on Linux where a window can be shown."""
_LARGEST = 1e100
"""Largest absolute value that is drawn, since an axis cannot span all numbers."""


def state_figure(
    system: System,
    t: np.ndarray,
    xhat: np.ndarray,
    *,
    x: np.ndarray | None = None,
    y: np.ndarray | None = None,
    P: np.ndarray | None = None,
    title: str = "",
    errors: bool = False,
) -> Figure:
    """Return a figure of estimates over time, with a panel per state.

    Of an angle, outputs and estimates are drawn at the values nearest to the true state. Where the
    true state or the estimate jumps by a period its line is broken. True states that are known in
    part are dots, at the values nearest to the estimates.

    Args:
        system: names and units.
        t: times in s, or steps of a map, shape (num_samples,).
        xhat: estimates, shape (num_samples, nx).
        x: true states (num_samples, nx), if known; NaN where they are not.
        y: outputs (num_samples, ny); those that directly measure a state are drawn as dots.
        P: covariances (num_samples, nx, nx), drawn as a band of two standard deviations.
        title: title of the figure.
        errors: whether a last panel shows the error of each state over its scale, if x is known.
    """
    rows = system.nx + errors
    figure, column = panels(rows, width=8, height=1.0 + 1.6 * rows)
    if errors and x is not None:
        _draw_errors(column[-1, 0], system, t, system.state_residual(xhat, x))
    measured = measured_states(system)
    references = None
    if x is not None and np.isnan(x).any():
        x, references = None, nearest(x, xhat, system.state_period)
    if y is not None:
        y = drawn_outputs(system, xhat if x is None else x, y)
    if x is not None:
        xhat = nearest(xhat, x, system.state_period)
    periods = system.state_period or [None] * system.nx
    shown = column[: system.nx, 0]
    for i, (panel, name) in enumerate(zip(shown, system.state_names, strict=True)):
        unit = system.units.get(name)
        panel.set_ylabel(plain(f"{name} ({unit})" if unit else name))
        if y is not None and i in measured:
            dots = _drawable(y[:, measured[i]])
            panel.plot(t, dots, ".", ms=2, color=MEASURED, label="measured")
        if x is not None:
            true = x[:, i]
            line = broken(jumps(true, periods[i]), t, true)
            panel.plot(*line, color=TRUE, lw=1.5, label="true")
        estimate = _drawable(xhat[:, i])
        kept = np.isfinite(estimate)
        breaks = jumps(estimate[kept], periods[i], None if x is None else x[kept, i])
        line = broken(breaks, t[kept], estimate[kept])
        panel.plot(*line, "--", color=ESTIMATE, lw=1.3, label="estimate")
        if P is not None:
            band = 2 * np.sqrt(_drawable(np.maximum(P[:, i, i], 0)))
            breaks = jumps(estimate, periods[i], None if x is None else x[:, i])
            area = broken(breaks, t, estimate - band, estimate + band)
            panel.fill_between(*area, color=ESTIMATE, alpha=0.15, lw=0)
        seen = x[:, i] if x is not None else estimate[kept]
        if references is not None:
            known = ~np.isnan(references[:, i])
            dots = references[known, i]
            # Under the estimate, as many dots together are as a line.
            panel.plot(t[known], dots, ".", ms=3, color=TRUE, label="reference", zorder=1.5)
            seen = np.concatenate([seen, dots])
        if len(seen):
            panel.set_ylim(*_limits(seen, float(system.scale[i])))
        panel.grid(alpha=0.3)
    column[0, 0].set_title(plain(title), fontsize=10)
    column[0, 0].legend(loc="upper right", fontsize=8, ncols=3)
    column[-1, 0].set_xlabel(f"t ({system.time_unit})")
    return figure


def _draw_errors(panel: Any, system: System, t: np.ndarray, error: np.ndarray) -> None:
    """Draw the absolute errors (num_samples, nx) over the states' scales, logarithmically."""
    scaled = abs(_drawable(error)) / np.asarray(system.scale, dtype=float)
    for name, curve in zip(system.state_names, scaled.T, strict=True):
        panel.plot(t, np.where(curve > 0, curve, np.nan), lw=1, label=plain(name))
    panel.set_yscale("log")
    panel.set_ylabel("|error| / scale")
    panel.grid(alpha=0.3)
    panel.legend(loc="upper right", fontsize=8, ncols=3)


def plain(text: str) -> str:
    """Return a text as Matplotlib draws it without mathematics: names may have dollar signs."""
    return text.replace("$", r"\$")


def drawn_outputs(system: System, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return outputs (..., ny), in which those that measure a state of x (..., nx), and repeat, are
    moved by whole periods to the values nearest to it."""
    if system.output_period is None:
        return y
    y = y.copy()
    for state, output in measured_states(system).items():
        period = (system.output_period[output],)
        y[..., [output]] = nearest(y[..., [output]], x[..., [state]], period)
    return y


def jumps(
    curve: np.ndarray, period: float | None, nearest_to: np.ndarray | None = None
) -> np.ndarray:
    """Return the samples at which a curve (num_samples,) of an angle jumps by a period.

    Args:
        curve: the angle, NaN where it is unknown.
        period: its period in its unit; None if it does not repeat, and thus never jumps.
        nearest_to: the true state (num_samples,) whose nearest value the curve is, if it is that of
            an estimate. The curve jumps with it, and where the estimate passes its opposite.
            Without it the curve jumps if it is wrapped: steps of more than half a period may also
            be those of a fast rotation, which soon spans more than two periods.
    """
    if period is None:
        return np.empty(0, dtype=int)
    if nearest_to is not None:
        apart = 1 + np.flatnonzero(abs(np.diff(curve - nearest_to)) > period / 2)
        return np.union1d(apart, jumps(nearest_to, period))
    known = curve[np.isfinite(curve)]
    if not len(known) or np.ptp(known) > 2 * period:
        return np.empty(0, dtype=int)
    return 1 + np.flatnonzero(abs(np.diff(curve)) > period / 2)


def broken(breaks: np.ndarray, t: np.ndarray, *curves: np.ndarray) -> list[np.ndarray]:
    """Return times and curves (num_samples,) with gaps before the samples ``breaks``."""
    return [np.insert(t, breaks, t[breaks]), *(np.insert(c, breaks, np.nan) for c in curves)]


def measured_states(system: System) -> dict[int, int]:
    """Return the index of each directly measured state, with the index of its output: an output
    that equals the state at any time and input, up to whole periods and their rounding error."""
    setup = system.setups["benchmark"]
    t = setup.duration * np.array([0.0, 0.37])
    x = initial_states(system, setup, 2)
    u = np.asarray(system.input(t)) + np.array([[0.0], [1.0]])
    y, H = np.asarray(system.h(t, x, u)), np.asarray(system.h_jacobian(t, x, u))
    measured = {}
    for output in range(system.ny):
        period = (system.output_period or [None] * system.ny)[output]
        error = 0.0 if period is None else _ROUNDING * period
        state = int(np.argmax(abs(H[0, output]) > error))
        off = residual(y[:, [output]], x[:, [state]], (period,))
        if (abs(H[:, output] - np.eye(system.nx)[state]) <= error).all() and (
            abs(off) <= error
        ).all():
            measured[state] = output
    return measured


def _drawable(values: np.ndarray) -> np.ndarray:
    """Return the values, with NaN in place of those that are too large to be drawn."""
    values = np.asarray(values, dtype=float)  # the bound is above all numbers of single precision
    return np.where(abs(values) <= _LARGEST, values, np.nan)


def _limits(values: np.ndarray, scale: float) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.1 * (high - low) + 0.15 * scale
    return low - margin, high + margin


class Metadata:
    """The ``metadata`` of a single env. Where there is no display, that of an instance leaves out
    the mode ``human``, so that whoever tries all modes, as Gymnasium's checker does, does not try
    this one; asked for by name, it says what is missing."""

    def __get__(self, env: Any, owner: type) -> dict[str, Any]:
        modes = ["human", "rgb_array"]
        hidden = sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS)
        if hidden and env is not None and env.render_mode != "human":
            modes.remove("human")
        return {"render_modes": modes, "render_fps": 30}


class EpisodePicture:
    """The running figure of an episode that an env renders.

    Static parts are drawn once per episode; each frame redraws only the curves.
    """

    def __init__(self, system: System, mode: str) -> None:
        self._system = system
        self._periods = system.state_period or [None] * system.nx
        self._mode = mode
        self._canvas: Any = None
        self._window: Any = None

    def begin(self, times: np.ndarray, x: np.ndarray, observations: np.ndarray) -> None:
        """Start an episode, given its sample times (num_samples,), true states and observations."""
        self._times, self._x = times, x
        self._y = drawn_outputs(self._system, x, observations[:, : self._system.ny])
        self._xhat = np.full_like(x, np.nan)
        self._background: Any = None

    def add(self, k: int, estimate: np.ndarray) -> None:
        """Store the estimate (nx,) of sample k."""
        self._xhat[k] = nearest(estimate, self._x[k], self._system.state_period)

    def draw(self, k: int) -> np.ndarray | None:
        """Draw the episode up to sample k, as an image (height, width, 3) of bytes or in the
        window."""
        if self._background is None:
            self._prepare()
        self._canvas.restore_region(self._background)
        shown = slice(0, k + 1)
        for panel, output, dots in self._dots:
            dots.set_data(self._times[shown], self._y[shown, output])
            panel.draw_artist(dots)
        curves = {"true": self._x, "estimate": self._xhat}
        for panel, state, label, line in self._lines:
            curve = curves[label][shown, state]
            true = None if label == "true" else self._x[shown, state]
            breaks = jumps(curve, self._periods[state], true)
            line.set_data(*broken(breaks, self._times[shown], curve))
            panel.draw_artist(line)
        image = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        if self._mode == "human":
            self._show(image)
            return None
        return image

    def close(self) -> None:
        """Close the window if it is open."""
        if self._window is not None:
            from matplotlib import pyplot

            pyplot.close(self._window[0])
            self._window = None

    def _prepare(self) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        empty = np.full_like(self._x, np.nan)
        figure = state_figure(
            self._system, self._times, empty, x=self._x, y=np.full_like(self._y, np.nan)
        )
        figure.set_dpi(80)
        self._canvas = FigureCanvasAgg(figure)
        self._lines, self._dots = [], []
        measured = measured_states(self._system)
        for state, panel in enumerate(figure.axes):
            panel.set_xlim(self._times[0], self._times[-1])
            for line in panel.lines:
                label = str(line.get_label())
                if label == "measured":
                    self._dots.append((panel, measured[state], line))
                else:
                    self._lines.append((panel, state, label, line))
                line.set_animated(True)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def _show(self, image: np.ndarray) -> None:
        from matplotlib import pyplot

        if self._window is None:
            if pyplot.get_backend().lower() == "agg":
                raise RuntimeError(
                    "render_mode='human' needs a display and a window toolkit for matplotlib, such"
                    " as PySide6; use render_mode='rgb_array' without them"
                )
            height, width = image.shape[:2]
            window = pyplot.figure(figsize=(width / 100, height / 100))
            shown = window.figimage(image)
            self._window = (window, shown)
            pyplot.show(block=False)
        window, shown = self._window
        shown.set_data(image)
        window.canvas.draw_idle()
        # As pyplot.pause, but without raising the window, which would take the focus at each frame.
        window.canvas.start_event_loop(1e-3)
