"""The model linearised at trajectories, with respect to states and to what a condition changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.conditions.base import Unknowns
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.residual import Periods, residual
from pinnobs_gym.simulation.system import System

_STEP = 1e-3
"""Step of central differences with respect to an unknown, relative to its standard deviation."""


@dataclass(frozen=True)
class Linearised:
    """The model at trajectories, with constant unknowns θ as further states: z = (x, θ)."""

    F: np.ndarray
    """Jacobians ∂z_{k+1}/∂z_k of the model's steps, shape (num_samples - 1, n, n, batch) with n =
    nx + num_unknowns."""
    Q: np.ndarray
    """Covariances of the process noise of z over the steps, shape (num_samples - 1, n, n,
    batch)."""
    H: np.ndarray
    """Jacobians ∂y_k/∂z_k of the received outputs, shape (num_samples, ny, n, batch)."""


def linearised(
    system: System, noise: Noise, t: np.ndarray, x: np.ndarray, unknowns: Sequence[Unknowns]
) -> Linearised:
    """Linearise the model's steps and the received outputs with respect to states and unknowns.

    Derivatives with respect to states are those of the model. With respect to unknowns, they are
    central differences of the model's step and outputs with plants that deviate.

    Args:
        system: the model.
        noise: its noise.
        t: sample times in s, shape (num_samples,).
        x: states at which to linearise, shape (num_samples, batch, nx).
        unknowns: what a condition changes, from `Condition.unknowns`.
    """
    batch, nx = x.shape[1:]
    # All samples of all episodes are rows of one batch.
    rows, times = x.reshape(-1, nx), np.repeat(t, batch)
    u = np.asarray(system.input(times))
    ends = (times[:-batch], times[batch:], rows[:-batch], u[:-batch], u[batch:])
    by_unknown = _derivatives(
        lambda plant: model_step(plant, *ends), system.state_period, system, unknowns, len(ends[0])
    )
    count = by_unknown.shape[-1]
    F, Q = np.zeros((2, len(ends[0]), nx + count, nx + count))
    _, by_state, of_state = model_step_moments(system, noise, *ends)
    F[:, :nx, :nx], Q[:, :nx, :nx] = by_state.transpose(2, 0, 1), of_state.transpose(2, 0, 1)
    F[:, :nx, nx:] = by_unknown
    F[:, nx:, nx:] = np.eye(count)  # unknowns are constant
    # Outputs change with the plant, and as a condition of the measurement says.
    by_unknown = _derivatives(
        lambda plant: plant.h(times, rows, u), system.output_period, system, unknowns, len(rows)
    )
    own = [each.output_slopes(system, times, rows, u) for each in unknowns]
    by_state = system.h_jacobian(times, rows, u)
    H = np.concatenate([by_state, by_unknown + np.concatenate(own, axis=-1)], axis=-1)
    parts = (each.reshape(-1, batch, *each.shape[1:]) for each in (F, Q, H))
    return Linearised(*(np.moveaxis(each, 1, -1) for each in parts))


def _derivatives(
    function: Callable[[System], np.ndarray],
    periods: Periods | None,
    system: System,
    unknowns: Sequence[Unknowns],
    rows: int,
) -> np.ndarray:
    """Return the derivatives (rows, k, num_unknowns) of a function of the plant, with values (rows,
    k) and periods, with respect to each unknown: central differences."""
    std = np.concatenate([each.std for each in unknowns])
    columns = []
    for i, step in enumerate(_STEP * std):
        deviations = np.zeros((rows, len(std)))
        deviations[:, i] = step
        larger, smaller = (function(_plant(system, unknowns, d)) for d in (deviations, -deviations))
        columns.append(residual(larger, smaller, periods) / (2 * step))
    return np.stack(columns, axis=-1)


def _plant(system: System, unknowns: Sequence[Unknowns], deviations: np.ndarray) -> System:
    """Return the system with these deviations, shape (batch, num_unknowns)."""
    first = 0
    for each in unknowns:
        system = each.plant(system, deviations[:, first : first + len(each.std)])
        first += len(each.std)
    return system
