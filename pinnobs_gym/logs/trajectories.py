"""The outputs of a model without process noise, and how they depend on its initial state and its
parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.noise import AssumedNoise, Noise, SampledLevel
from pinnobs_gym.simulation.residual import residual
from pinnobs_gym.simulation.system import Setup, System, vector

_STEP = 6e-6
"""Step of central differences, over the size of what is changed."""
_STIFF_STEP = 1e-4
"""That of stiff plants, whose steps are chosen in each trajectory by itself."""


@dataclass(frozen=True)
class Trajectory:
    """A trajectory of the model beside the outputs of a log."""

    yhat: np.ndarray
    """Outputs of the model, shape (num_samples, ny)."""
    residual: np.ndarray
    """Those of the log less those of the model, angles wrapped; zero where there is none."""
    whitened: np.ndarray
    """The residuals in standard deviations of the output noise, independent of each other."""
    slopes: np.ndarray
    """Derivatives of the outputs by initial state and parameters, in the units of the whitened
    residuals, shape (num_samples, ny, nx + number of parameters)."""
    std: np.ndarray
    """Standard deviations of the output noise, shape (num_samples, ny)."""


def simulated(system: System, t: np.ndarray, u: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the outputs (num_samples, batch, ny) of the model without process noise.

    Args:
        system: the model; its parameters may be arrays (batch,).
        t: sample times in s, shape (num_samples,).
        u: inputs at the samples, shape (num_samples, 1, nu).
        x: initial states, shape (batch, nx).
    """
    states = np.empty((len(t), *x.shape))
    times = t.tolist()
    for k in range(len(t)):
        if k:
            x = model_step(system, times[k - 1], times[k], x, u[k - 1], u[k])
        states[k] = x
    return np.asarray(system.h(t[:, None], states, u))


def whitening(noise: AssumedNoise, t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return W (num_samples or 1, ny, ny) with WᵀW = R⁻¹ of each sample, in which missing outputs
    have no part.

    Args:
        noise: the noise that the model assumes.
        t: sample times in s, shape (num_samples,).
        y: outputs, shape (num_samples, ny); NaN marks a missing one.
    """
    same = noise.samples is None and type(noise.told) is Noise
    R = noise.R(0.0)[..., 0]
    if not same or (np.isnan(y).any() and np.count_nonzero(R) > len(R)):
        each = [noise.R(float(now), y[k, None])[..., 0] for k, now in enumerate(t)]
        return np.linalg.inv(np.linalg.cholesky(np.stack(each)))
    return np.linalg.inv(np.linalg.cholesky(R))[None]


class Sensitivity:
    """The trajectories of a model through one log, as rows of one batch: one from the initial state
    and the parameters that are asked for, and two for each of them that is changed by a small step.

    `pinnobs_gym.estimation.least_squares` finds the same slopes along one trajectory, from the
    Jacobians of its steps. The rows of a batch take less time in compiled code, need no Jacobian by
    parameters, and have the same slopes to about 1e-9.

    Args:
        log: the log.
        setup: the output noise.
        parameters: what is unknown beside the initial state.
    """

    def __init__(self, log: Log, setup: Setup, parameters: Parameters) -> None:
        self.log, self.parameters = log, parameters
        system, record = log.system, log.record
        level = setup.noise_std
        if record.noise_std is not None:
            level = SampledLevel(record.t, record.noise_std, level)
        noise = AssumedNoise.of(system, system.noise(level, 0.0))
        self._y, self._u = record.y[0], record.u.swapaxes(0, 1)
        self._missing = np.isnan(self._y)
        self._W = whitening(noise, record.t, self._y)
        variance = np.einsum("kii->ki", np.linalg.inv(self._W.swapaxes(1, 2) @ self._W))
        self._std = np.broadcast_to(np.sqrt(variance), self._y.shape)
        self._scale = np.r_[
            vector(system.scale, system.nx, "scale"), np.ones(len(parameters.names))
        ]
        self._step = _STIFF_STEP if system.stiff else _STEP
        self._low, self._high = limits(system, parameters)

    def along(self, point: np.ndarray, length: int) -> Trajectory:
        """Return the trajectory through the first samples of the log.

        Args:
            point: initial state and parameters in units of their scale, shape (nx + number of
                parameters,).
            length: number of samples.
        """
        rows = self._rows(point)
        yhat = self._outputs(rows, length)
        system, n = self.log.system, len(point)
        missing = self._missing[:length]
        off = np.where(missing, 0.0, system.output_residual(self._y[:length], yhat[:, 0]))
        width = rows[1 : n + 1] - rows[n + 1 :]
        change = residual(yhat[:, 1 : n + 1], yhat[:, n + 1 :], system.output_period)
        slopes = change.swapaxes(1, 2) / width.diagonal()
        slopes[missing] = 0.0
        W = self._W[:length] if len(self._W) > 1 else self._W
        return Trajectory(
            yhat[:, 0], off, (W @ off[..., None])[..., 0], W @ slopes, self._std[:length]
        )

    def _rows(self, point: np.ndarray) -> np.ndarray:
        """Return the points of all rows, (1 + 2n, n), within the bounds."""
        n = len(point)
        rows = np.repeat(point[None], 1 + 2 * n, axis=0)
        step = self._step * np.maximum(abs(point), self._scale)
        rows[1 + np.arange(n), np.arange(n)] += step
        rows[1 + n + np.arange(n), np.arange(n)] -= step
        return np.clip(rows, self._low, self._high)

    def _outputs(self, rows: np.ndarray, length: int) -> np.ndarray:
        nx, record = self.log.system.nx, self.log.record
        system = self.parameters.of(self.log.system, self.parameters.values(rows[:, nx:]))
        with np.errstate(all="ignore"):  # a trajectory that diverges is not finite
            return simulated(system, record.t[:length], self._u[:length], rows[:, :nx].copy())


def limits(system: System, parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (nx + number of parameters,) of states and of parameters in units of their
    scale; infinite where there is none."""
    box, nx = system.state_box, system.nx
    low, high = np.full(nx, -np.inf), np.full(nx, np.inf)
    if box is not None:
        low, high = box.low, box.high
    start, scale = parameters.start, parameters.scale
    return np.r_[low, (parameters.low - start) / scale], np.r_[
        high, (parameters.high - start) / scale
    ]
