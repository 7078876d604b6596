"""Extended Kalman filters with different parameters and noise, as rows of one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pinnobs_gym.estimation.square_root import WIDE
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.noise import AssumedNoise, Level, SampledLevel, noise_root
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, output_scale, vector

_MARGIN = 1.5
"""Factor by which the noise of outputs is kept above that with which filters carry roots."""
_ENTRIES = 2**23
"""About how many numbers the results of a filter on several rows have."""


class FilterRows:
    """The filters of several logs, given values of the unknowns, rows v (batch, n): the parameters
    in units of their scale, less the start, then the logarithms of the factors on the told noise of
    outputs, and on the process noise.

    The process noise that the model tells has one factor. If it tells none, each state has a factor
    of its own on noise that moves it by its scale over the longest log.

    Args:
        logs: the logs.
        setup: the told noise.
        parameters: the unknown ones.
        noise: whether the noise is unknown, too.
    """

    def __init__(
        self, logs: Sequence[Log], setup: Setup, parameters: Parameters, noise: bool
    ) -> None:
        system = logs[0].system
        self.logs, self._parameters = logs, parameters
        told = system.noise(setup.noise_std, setup.process_noise)
        self.usual = noise and not told.stochastic
        """Whether the model tells no process noise, but noise is to be found."""
        if self.usual:
            setup = replace(setup, process_noise=_usual_process_noise(logs))
        self._level = setup.noise_std
        self.L = noise_root(setup.process_noise, system.nx, "process_noise")
        """L of the process noise of which factors are found, shape (nx, m)."""
        self.std = np.sqrt(np.einsum("iib->i", AssumedNoise.of(system, told).R(0.0)))
        """Standard deviations of the told output noise, shape (ny,)."""
        self.outputs = np.flatnonzero(_untold(logs)) if noise else np.empty(0, dtype=int)
        """Numbers of the outputs whose noise is unknown: those not told by sample in a log."""
        sizes = len(parameters.names), len(self.outputs), (system.nx if self.usual else int(noise))
        self.sizes = sizes
        """Numbers of unknown parameters, of output noise and of process noise."""

    def factors(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors on the noise of outputs (batch, ny), and of states (batch, nx)."""
        p, r, q = self.sizes
        outputs, process = np.ones((len(rows), len(self.std))), np.ones((len(rows), len(self.L)))
        outputs[:, self.outputs] = np.exp(rows[:, p : p + r])
        if q:
            process[:] = np.exp(rows[:, p + r :])
        return outputs, process

    def smallest(self, share: float) -> np.ndarray:
        """Return the smallest factors on the unknown noise of outputs: a share of what is told, but
        none for which the prior is so wide that filters carry roots of covariances
        (`pinnobs_gym.estimation.square_root`), which takes a hundred times as long."""
        log = self.logs[0]
        std = np.sqrt(np.stack([np.diagonal(each.record.prior.cov[0]) for each in self.logs]))
        widest = float((std / vector(log.system.scale, log.system.nx, "scale")).max())
        least = _MARGIN * widest / WIDE * output_scale(log.system) / self.std
        return np.minimum(1.0, np.maximum(share, least))[self.outputs]

    def chunks(self, log: Log, count: int) -> list[slice]:
        """Return the parts of a number of rows that are filtered at once, so that memory lasts."""
        nx, ny = log.system.nx, log.system.ny
        size = max(1, _ENTRIES // (len(log.record.t) * (nx + nx * nx + 2 * ny + ny * ny)))
        return [slice(k, min(k + size, count)) for k in range(0, count, size)]

    def run(self, log: Log, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the innovations (batch, num_samples, ny) of a log, and their covariances (batch,
        num_samples, ny, ny)."""
        outputs, process = self.factors(rows)
        shape = (len(rows), *log.record.y.shape[1:])
        e, S = np.empty(shape), np.empty((*shape, shape[-1]))
        kinds, kind = np.unique(process, axis=0, return_inverse=True)
        for i, factors in enumerate(kinds):  # compiled filters have one process noise
            chosen = np.flatnonzero(kind.ravel() == i)
            e[chosen], S[chosen] = self.filtered(log, rows[chosen], outputs[chosen], factors)
        return e, S

    def filtered(
        self, log: Log, rows: np.ndarray, outputs: np.ndarray, factors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what `run` does, with factors (batch, ny) on the noise of outputs, and the same
        factors (nx,) on the process noise in all rows."""
        record, count = log.record, len(rows)
        L = factors[:, None] * self.L
        process: Level = tuple(map(tuple, L.tolist())) if L.any() else 0.0
        ekf = EKF(self._system(log, rows), self._noise(record, outputs), process, assumed_noise=0.0)
        estimates = ekf.run(_repeated(record, count))
        assert estimates.innovation is not None
        assert estimates.S is not None
        return estimates.innovation, estimates.S

    def _system(self, log: Log, rows: np.ndarray) -> System:
        p = self.sizes[0]
        if not p:
            return log.system
        return self._parameters.of(log.system, self._parameters.values(rows[:, :p]))

    def _noise(self, record: Record, outputs: np.ndarray) -> Level | SampledLevel:
        """Return the noise of the outputs of a record, with factors (batch, ny)."""
        told = record.noise_std
        if not len(self.outputs) and told is None:
            return self._level
        std = np.broadcast_to((outputs * self.std)[:, None], (len(outputs), *record.y.shape[1:]))
        if told is not None:
            std = np.where(np.isnan(told), std, told)
        return SampledLevel(record.t, std, self._level)


def _usual_process_noise(logs: Sequence[Log]) -> Level:
    """Return process noise that moves each state by its scale over the longest log."""
    system = logs[0].system
    duration = max(float(np.ptp(log.record.t)) for log in logs)
    return tuple((vector(system.scale, system.nx, "scale") / np.sqrt(duration or 1.0)).tolist())


def _untold(logs: Sequence[Log]) -> np.ndarray:
    """Return which outputs have a noise that the logs do not tell by sample, bool (ny,)."""
    untold: np.ndarray = np.zeros(logs[0].system.ny, dtype=bool)
    for log in logs:
        y, std = log.record.y[0], log.record.noise_std
        present = ~np.isnan(y)
        untold |= (present if std is None else present & np.isnan(std[0])).any(axis=0)
    return untold


def _repeated(record: Record, count: int) -> Record:
    """Return a record of several equal rows from one of one row."""
    prior = Prior(np.repeat(record.prior.mean, count, 0), np.repeat(record.prior.cov, count, 0))
    return Record(record.t, np.repeat(record.y, count, 0), np.repeat(record.u, count, 0), prior)
