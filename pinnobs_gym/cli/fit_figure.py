"""The figure of a model that was fitted to logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.envs.figures import ESTIMATE, MEASURED, plain
from pinnobs_gym.envs.panels import panels
from pinnobs_gym.logs.fit import Fit
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.simulation.residual import nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 3
"""Largest number of logs that are drawn."""
_DRAWN = 20_000
"""About how many samples of a log are drawn."""


def fit_figure(logs: Sequence[Log], fit: Fit) -> Figure:
    """Return a figure with a column for each of the first logs. It has two panels for each output:
    measured values with those of the fitted model, and the residuals with two standard deviations
    that are expected of them."""
    system, shown = fit.system, list(logs)[:_SHOWN]
    width, height = 2.0 + 6.0 * len(shown), 1.0 + 2.8 * system.ny
    figure, axes = panels(2 * system.ny, len(shown), width=width, height=height, between=0.25)
    for i, log in enumerate(shown):
        every = slice(None, None, max(1, len(log.record.t) // _DRAWN))
        t, y, yhat, std = (
            a[every] for a in (log.record.t, log.record.y[0], fit.yhat[i], fit.std[i])
        )
        off = np.asarray(system.output_residual(y, yhat))
        drawn = nearest(y, yhat, system.output_period)
        for j, name in enumerate(system.output_names):
            unit = system.units.get(name)
            above, below = axes[2 * j, i], axes[2 * j + 1, i]
            above.plot(t, drawn[:, j], ".", ms=2, color=MEASURED, label="measured")
            above.plot(t, yhat[:, j], color=ESTIMATE, lw=1.0, label="model")
            below.plot(t, off[:, j], ".", ms=2, color=MEASURED)
            below.fill_between(t, -2 * std[:, j], 2 * std[:, j], color=ESTIMATE, alpha=0.15, lw=0)
            above.set_ylabel(plain(f"{name} ({unit})" if unit else name))
            below.set_ylabel("residual")
            below.set_ylim(*_around(off[:, j], std[:, j]))
            above.tick_params(labelbottom=False)
            for panel in (above, below):
                panel.grid(alpha=0.3)
        title = plain(f"{log.path.name}: {type(system).__name__}")
        axes[0, i].set_title(title, fontsize=10)
        axes[-1, i].set_xlabel(f"t ({system.time_unit})")
    axes[0, 0].legend(loc="upper right", fontsize=8, ncols=2)
    return figure


def _around(off: np.ndarray, std: np.ndarray) -> tuple[float, float]:
    """Return limits of a panel of residuals, which outliers and a first sample do not widen."""
    known = abs(off[np.isfinite(off)])
    size = max(
        3 * float(np.median(std)), 1.5 * float(np.quantile(known, 0.99)) if len(known) else 0
    )
    return -size, size
