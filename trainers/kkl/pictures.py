"""Figures of a trained KKL observer."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.envs.panels import ABOVE, BELOW, LEFT, panels
from pinnobs_gym.estimators.kkl import KKL, TrainedKKL
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.truth import truth
from trainers.kkl.labels import driven, initial_states, steady

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GRID = 51
"""Grid points along each side of a map."""
RADII = np.linspace(0.1, 2.0, 14)
"""Distances of initial states from the middle of the training set, over that of its edge."""
_RAYS = 12
_FLOOR = 1e-6
"""Smallest error that is shown."""
_BAR = 0.8
"""Width in inches of the numbers and the name beside a bar of colours."""


def figures(system: System, trained: TrainedKKL, record: Record) -> dict[str, Figure]:
    """Return all figures by name.

    They are the ``error`` over the state space, the error against the initial ``radius``, the
    ``maps`` T and T*, and the ``sweep`` if there was one. If T depends on time, there are no
    ``error`` and ``maps``, and if inputs are drawn, no ``radius`` either.
    """
    drawn = {}
    if not system.draws_input:
        drawn["radius"] = radius_figure(system, trained, record)
    if not driven(system):
        drawn["error"] = error_figure(system, trained, record)
        drawn["maps"] = maps_figure(system, trained)
    if trained.facts.get("sweep"):
        drawn["sweep"] = sweep_figure(trained)
    return drawn


def _plane(system: System, trained: TrainedKKL) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a grid over the first two states, a little beyond the states trained on.

    Returns:
        The values (GRID,) of both states, and the states (GRID, GRID, nx) of the grid, whose
        further components are those of the benchmark's x̂₀.
    """
    low, high = (np.array(trained.facts[name]) for name in ("low", "high"))
    margin = 0.25 * (high - low)
    sides = [np.linspace(low[i] - margin[i], high[i] + margin[i], GRID) for i in range(2)]
    x = np.empty((GRID, GRID, system.nx))
    x[:], _ = prior_moments(system, system.setups["benchmark"])
    x[..., 1], x[..., 0] = np.meshgrid(sides[1], sides[0], indexing="ij")
    return sides[0], sides[1], x


def _late(trained: TrainedKKL) -> float:
    """Return a time in s at which the transient of z has decayed."""
    return 20 / trained.dynamics.slowest


def error_figure(system: System, trained: TrainedKKL, record: Record) -> Figure:
    """Plot the scaled error of T*(T(x)) over the first two states.

    T(x) is integrated, without noise. The box of the training states and an episode are drawn, too.
    """
    from matplotlib.colors import LogNorm

    first, second, x = _plane(system, trained)
    states = x.reshape(-1, system.nx)
    h = float(np.diff(record.t).mean())
    z, stays = steady(system, trained.dynamics, states, h)
    error = np.full(len(states), np.nan)
    xhat = trained.inverse(z[stays], _late(trained), np.zeros(system.nu))
    scale = vector(system.scale, system.nx, "scale")
    off = system.state_residual(xhat, states[stays]) / scale
    error[stays] = np.sqrt((off**2).mean(axis=-1))
    figure, ((panel,),) = panels(1, width=6.5, height=5, after=_BAR)
    shown = np.maximum(error, _FLOOR).reshape(GRID, GRID)
    image = panel.pcolormesh(first, second, shown, norm=LogNorm(_FLOOR, 1.0), cmap="viridis")
    figure.colorbar(image, label="scaled error of x̂")
    low, high = (np.array(trained.facts[name]) for name in ("low", "high"))
    across, up = [0, 1, 1, 0, 0], [0, 0, 1, 1, 0]
    box = np.stack([low, high])
    panel.plot(box[across, 0], box[up, 1], ":", color="0.7", lw=1.5, label="states trained on")
    path = truth(system, _starts(system, trained, 1), record.t)[:, 0]
    panel.plot(path[:, 0], path[:, 1], color="#d1495b", lw=1, label="an episode")
    panel.set_xlabel(system.state_names[0])
    panel.set_ylabel(system.state_names[1])
    others = [
        f"{name} = {value:g}"
        for name, value in zip(system.state_names[2:], states[0][2:], strict=True)
    ]
    panel.set_title(", ".join([f"{trained.trainer}, without noise", *others]), fontsize=10)
    panel.legend(loc="upper right", fontsize=8)
    return figure


def _starts(system: System, trained: TrainedKKL, count: int) -> np.ndarray:
    """Draw new initial states (count, nx) from the set trained on."""
    low, high = (trained.config[name] for name in ("low", "high"))
    return initial_states(system, low, high, count, 10**6 + 7)


def radius_figure(system: System, trained: TrainedKKL, record: Record) -> Figure:
    """Plot the error over the last quarter of noise-free episodes against the initial radius.

    The radius is the distance from the middle of the training set over that of its edge. The error
    is that of T*, also where an observer with a fallback would take that.
    """
    x0 = _starts(system, trained, 400)
    middle = (x0.min(axis=0) + x0.max(axis=0)) / 2
    reach = (x0.max(axis=0) - x0.min(axis=0)) / 2
    size = abs((x0 - middle) / np.where(reach > 0, reach, 1.0)).max(axis=1)
    outer = x0[np.argsort(-size)[:_RAYS]]
    x0 = middle + RADII[:, None, None] * (outer - middle)
    errors = _tails(system, trained, record, x0)
    figure, ((panel,),) = panels(1, width=6.5, height=4)
    low, mid, high = np.nanquantile(errors, [0.1, 0.5, 0.9], axis=1)
    panel.fill_between(RADII, low, high, alpha=0.25, lw=0, label="80 % of episodes")
    panel.semilogy(RADII, mid, lw=1.5, label="median")
    panel.axvspan(1.0, RADII[-1], color="#d1495b", alpha=0.08, label="outside the training set")
    panel.set_xlabel("initial radius, over that of the training set")
    panel.set_ylabel("NRMSE of the last quarter")
    panel.set_title(f"{trained.trainer}, without noise", fontsize=10)
    panel.legend(fontsize=8)
    panel.grid(alpha=0.3)
    return figure


def _tails(system: System, trained: TrainedKKL, record: Record, x0: np.ndarray) -> np.ndarray:
    """Return the NRMSE (groups, batch) over the last quarter of episodes from states
    (groups, batch, nx); NaN in groups with a diverging episode."""
    states = x0.reshape(-1, system.nx)
    try:
        x = truth(system, states, record.t).swapaxes(0, 1)
    except FloatingPointError:
        if len(x0) == 1:
            return np.full(x0.shape[:2], np.nan)
        return np.concatenate([_tails(system, trained, record, group[None]) for group in x0])
    mean = np.broadcast_to(record.prior.mean[:1], states.shape)
    cov = np.broadcast_to(record.prior.cov[:1], (len(states), system.nx, system.nx))
    u = np.broadcast_to(system.input(record.t), (len(states), len(record.t), system.nu))
    episodes = Record(record.t, system.h(record.t, x, u), u, Prior(mean, cov))
    xhat = KKL(system, trained=replace(trained, region=None)).run(episodes).xhat
    late = slice(3 * len(record.t) // 4, None)
    scale = vector(system.scale, system.nx, "scale")
    square = ((system.state_residual(xhat, x)[:, late] / scale) ** 2).mean(axis=(1, 2))
    return np.sqrt(square).reshape(x0.shape[:2])


def maps_figure(system: System, trained: TrainedKKL) -> Figure:
    """Plot components of T over the first two states, and of T* over the plane of the first two
    principal components of z."""
    first, second, x = _plane(system, trained)
    z = trained.T(x)
    shown = min(trained.dynamics.size, 3)
    columns = max(shown, min(system.nx, 3))
    figure, grid = panels(
        2,
        columns,
        width=LEFT + 3.4 * columns,
        height=6,
        beside=_BAR,
        after=_BAR,
        between=BELOW + ABOVE,
    )
    for i in range(shown):
        image = grid[0, i].pcolormesh(first, second, z[..., i], cmap="viridis")
        figure.colorbar(image, ax=grid[0, i])
        grid[0, i].set_title(f"T: z{i + 1}", fontsize=10)
        grid[0, i].set_xlabel(system.state_names[0])
    grid[0, 0].set_ylabel(system.state_names[1])
    flat = trained.T(_starts(system, trained, 500))
    mean = flat.mean(axis=0)
    _, sizes, axes = np.linalg.svd(flat - mean, full_matrices=False)
    reach = 2.5 * sizes[:2] / np.sqrt(len(flat))
    sides = [np.linspace(-r, r, GRID) for r in reach]
    a, b = np.meshgrid(*sides)
    plane = mean + a[..., None] * axes[0] + b[..., None] * axes[1]
    xhat = trained.inverse(plane, _late(trained), np.zeros(system.nu))
    for i in range(min(system.nx, 3)):
        image = grid[1, i].pcolormesh(*sides, xhat[..., i], cmap="viridis")
        figure.colorbar(image, ax=grid[1, i])
        grid[1, i].set_title(f"T*: {system.state_names[i]}", fontsize=10)
        grid[1, i].set_xlabel("first axis of z")
    grid[1, 0].set_ylabel("second axis of z")
    for panel in grid.ravel():
        if not panel.has_data():
            panel.set_axis_off()
    return figure


def sweep_figure(trained: TrainedKKL) -> Figure:
    """Plot error, noise gain and convergence time over the cut-off, with the chosen one marked."""
    points = trained.facts["sweep"]
    cutoff = [point["cutoff"] for point in points]
    figure, column = panels(3, width=6.5, height=6)
    for name in ("noisy", "clean"):
        values = [point[name] for point in points]
        column[0, 0].loglog(cutoff, values, "o-", label=f"{name} outputs")
    column[0, 0].set_ylabel("NRMSE at the end")
    column[0, 0].legend(fontsize=8)
    for panel, name, label in (
        (column[1, 0], "noise_gain", "noise gain"),
        (column[2, 0], "convergence", "convergence (s)"),
    ):
        panel.semilogx(cutoff, [point[name] for point in points], "o-")
        panel.set_ylabel(label)
    for panel in column[:, 0]:
        panel.axvline(trained.config["cutoff"], color="#d1495b", ls="--", lw=1)
        panel.grid(alpha=0.3)
    column[2, 0].set_xlabel("cut-off (Hz)")
    title = f"{trained.system}: {trained.trainer}, cut-off chosen in red"
    column[0, 0].set_title(title, fontsize=10)
    return figure
