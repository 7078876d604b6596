"""Pictures of estimates, also of those that diverged."""

import numpy as np
import pytest
from drawn import cut_off
from matplotlib.backends.backend_agg import FigureCanvasAgg

from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.envs.panels import panels
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


@pytest.mark.parametrize("value", [1e150, 1.7e308, np.inf, np.nan])
@pytest.mark.parametrize("known", [True, False])
def test_estimates_that_diverged_are_drawn_as_far_as_they_go(value, known):
    """Warnings, such as of overflow, are errors here."""
    t = np.linspace(0, 1, 50)
    xhat, P = np.ones((50, 2)), np.tile(np.eye(2), (50, 1, 1))
    xhat[20:] = value * np.where(np.arange(30) % 2, 1, -1)[:, None]
    P[30:] = value
    x = np.zeros((50, 2)) if known else None
    figure = state_figure(ReverseDuffing(), t, xhat, x=x, y=np.zeros((50, 1)), P=P)
    FigureCanvasAgg(figure).draw()
    for panel in figure.axes:
        (line,) = (line for line in panel.lines if line.get_label() == "estimate")
        np.testing.assert_array_equal(line.get_xdata(), t[:20])


@pytest.mark.parametrize("size", [2.5e-4, 1.0, 7e4, -3e9])
@pytest.mark.parametrize("rows", [1, 2, 9])
def test_nothing_is_cut_off(size, rows):
    figure, column = panels(rows, width=8, height=1 + 1.6 * rows)
    for panel in column[:, 0]:
        panel.plot([0, 1000], [-size, size])
        panel.set_ylabel("armature current (kA)")
    column[-1, 0].set_xlabel("t (s)")
    column[0, 0].set_title("pinnobs/InductionMotor-v0, noise5+dropout10: strong_tracking_ekf")
    assert not cut_off(figure)
    column[0, 0].set_ylabel("a name that is longer than the panel is high, " * 4)
    assert cut_off(figure)


def test_dollar_signs_in_names_are_no_formulas():
    """Else such a title, of a log's file, could not be drawn."""
    title = r"$\frac$.csv costs $2"
    x = np.zeros((3, 2))
    figure = state_figure(ReverseDuffing(), np.arange(3.0), x, title=title)
    FigureCanvasAgg(figure).draw()
    plain = figure.axes[0].title.get_text()
    assert plain.replace(r"\$", "$") == title
