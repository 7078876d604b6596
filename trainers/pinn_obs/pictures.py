"""Figures of a trained PINN-Obs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.envs.panels import panels
from pinnobs_gym.estimators.pinn_obs import TrainedNetwork
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figures(system: System, trained: TrainedNetwork) -> dict[str, Figure]:
    """Return the figures of the estimates (``states``) and the ``gain`` over the record's times."""
    title = f"PINN-Obs on {trained.system}, loss {trained.loss:.3g}"
    states = state_figure(system, trained.t, trained.xhat(trained.t), y=trained.y, title=title)
    return {"states": states, "gain": gain_figure(trained.t, trained.gain(trained.t))}


def gain_figure(t: np.ndarray, L: np.ndarray) -> Figure:
    """Plot gains L (num_samples, nx, ny) over times t (num_samples,) in s, with a panel per state
    and a line per output."""
    nx, ny = L.shape[1:]
    figure, column = panels(nx, width=8, height=1.0 + 1.6 * nx)
    for i, panel in enumerate(column[:, 0]):
        for j in range(ny):
            panel.plot(t, L[:, i, j], lw=1.2, label=f"L{i + 1}{j + 1}")
        panel.legend(loc="upper right", fontsize=8)
        panel.grid(alpha=0.3)
    column[-1, 0].set_xlabel("t (s)")
    return figure
