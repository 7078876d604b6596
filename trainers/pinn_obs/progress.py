"""What is shown of a training while it runs and when it ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.estimators.pinn_obs import Trained
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.log import Log
from trainers.pinn_obs.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TERMS = ("initial", "equation", "output")


def log_terms(log: Log, run: Run) -> None:
    """The curves of the loss, its terms, the best so far, and the loss on samples that are not
    trained on."""
    terms = run.terms()
    log.scalar("loss/total", run.total(terms), run.iteration)
    for name, term in zip(_TERMS, terms.tolist(), strict=True):
        log.scalar(f"loss/{name}", term, run.iteration)
    if run.best is not None:
        log.scalar("loss/best", run.best.loss, run.iteration)
    if log.active and (loss := run.held_out()) is not None:
        log.scalar("loss/held_out", loss, run.iteration)


def log_end(log: Log, system: System, trained: Trained, run: Run) -> None:
    """Figures of what came out, and the row of the HPARAMS table."""
    if not log.active:
        return
    title = f"PINN-Obs on {trained.system}, loss {trained.loss:.3g}"
    states = state_figure(system, trained.t, trained.xhat(trained.t), y=trained.y, title=title)
    log.figure("states", states, run.iteration)
    log.figure("gain", gain_figure(trained.t, trained.gain(trained.t)), run.iteration)
    metrics = {"end/loss": trained.loss, "end/iterations": float(trained.iterations)}
    log.hparams({"system": trained.system, **trained.config}, metrics)


def gain_figure(t: np.ndarray, L: np.ndarray) -> Figure:
    """A picture of gains L (num_samples, nx, ny) over times t (num_samples,) in s: a panel per
    state, a line per output."""
    from matplotlib.figure import Figure

    nx, ny = L.shape[1:]
    figure = Figure(figsize=(8, 1.0 + 1.6 * nx), layout="constrained")
    panels = figure.subplots(nx, 1, sharex=True, squeeze=False)[:, 0]
    for i, panel in enumerate(panels):
        for j in range(ny):
            panel.plot(t, L[:, i, j], lw=1.2, label=f"L{i + 1}{j + 1}")
        panel.legend(loc="upper right", fontsize=8)
        panel.grid(alpha=0.3)
    panels[-1].set_xlabel("t (s)")
    return figure


def described(run: Run) -> str:
    """The terms of the loss and the best so far, in a line."""
    parts = zip(_TERMS, run.terms().tolist(), strict=True)
    text = " ".join(f"{name} {value:.2e}" for name, value in parts)
    best = f"{run.best.loss:.2e}" if run.best else "none"
    return f"{text} best {best}"
