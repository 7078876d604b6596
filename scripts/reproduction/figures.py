"""Figures of a training, based on those of the package and the trainer."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.envs.panels import panels
from pinnobs_gym.estimators.pinn_obs import TrainedNetwork
from pinnobs_gym.scoring.playing import Played
from trainers.pinn_obs.pictures import gain_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def estimates_figure(played: Played, title: str) -> Figure:
    """Plot the true states and estimates of an episode, with the legend above the curves."""
    figure = played.figure(title)
    top = figure.axes[0]
    legend = top.get_legend()
    assert legend is not None
    legend.remove()
    handles, labels = top.get_legend_handles_labels()
    top.set_title("")
    top.set_title(title, fontsize=10, loc="left")
    figure.legend(handles, labels, loc="upper right", ncols=3, fontsize=8, borderaxespad=0.2)
    return figure


def readable_gain_figure(trained: TrainedNetwork) -> Figure:
    """Plot the learned gains over the record.

    If a state's gain exceeds ten times its 95 % quantile, as it may right after t₀, the scale is
    logarithmic above that quantile, rounded up to a power of ten.
    """
    L = trained.gain(trained.t)
    figure = gain_figure(trained.t, L)
    for i, panel in enumerate(figure.axes):
        sizes = abs(L[:, i])
        panel.legend(loc="best", fontsize=8)
        usual = float(np.quantile(sizes, 0.95))
        if 0 < 10 * usual < sizes.max():
            panel.set_yscale("symlog", linthresh=10 ** math.ceil(math.log10(usual)))
    figure.axes[0].set_title(f"{trained.system}: learned gain", fontsize=10)
    return figure


def loss_figure(curve: np.ndarray, title: str) -> Figure:
    """Plot the least loss over iterations, from points (num_points, 2)."""
    figure, ((panel,),) = panels(1, width=8, height=3)
    panel.semilogy(curve[:, 0], curve[:, 1], lw=1.3)
    panel.set_title(title, fontsize=10)
    panel.set_xlabel("iteration")
    panel.set_ylabel("least loss so far")
    panel.grid(alpha=0.3)
    return figure
