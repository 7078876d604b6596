"""Training streams of a gain: parts of smoothed records with simulated outputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_gain.rollout import FilterState, Model, Weights, predict, update
from trainers.pinn_gain.smooth import Smoothed

NOMINAL = 0.5
"""Probability that a stream has the output noise given to the trainer."""
NOISE = (0.3, 8.0)
"""Range of the noise of the other streams, over that noise; its logarithm is uniform."""
MIDDLE = 0.05
"""Probability that a new stream begins within a record, with x̂ drawn from N(x, diag P₀)."""
RESTART = 0.5
"""Probability that a stream is replaced after a chunk."""
_FAR = 5.0
"""Scaled error above which a stream is replaced."""


@dataclass(frozen=True)
class Data:
    """Smoothed records and their priors."""

    t: np.ndarray
    """Sample times in s, shape (num_samples,)."""
    x: np.ndarray
    """Smoothed trajectories, shape (records, num_samples, nx)."""
    y: np.ndarray
    """Noise-free outputs of these trajectories, shape (records, num_samples, ny)."""
    u: np.ndarray
    """Inputs, shape (records, num_samples, nu)."""
    mean: np.ndarray
    """Prior means x̂₀, shape (records, nx)."""
    cov: np.ndarray
    """Prior covariances P₀, shape (records, nx, nx)."""

    @staticmethod
    def of(system: System, record: Record, smoothed: Smoothed, rows: np.ndarray) -> Data:
        """Return the data of some rows of a record."""
        x = smoothed.xhat[rows]
        prior = record.prior
        u = record.u[rows]
        y = system.h(record.t, x, u)
        return Data(record.t, x, y, u, prior.mean[rows], prior.cov[rows])


class Streams:
    """The state of all streams and their random generator.

    Args:
        model: the model and the variant of the network.
        data: the smoothed training records.
        std: standard deviations of the output noise given to the trainer, shape (ny,).
        batch: number of streams.
        chunk: samples per chunk.
        memory: size and initial value of the network's memory.
        seed: seed of all random numbers.
    """

    def __init__(
        self,
        model: Model,
        data: Data,
        std: np.ndarray,
        batch: int,
        chunk: int,
        memory: tuple[int, float],
        seed: int,
    ) -> None:
        self.model, self.data, self.std, self.chunk = model, data, std, chunk
        self.rng = np.random.default_rng(seed)
        nx = model.system.nx
        self.record, self.position = np.zeros(batch, int), np.zeros(batch, int)
        self.factor, self.new = np.ones(batch), np.ones(batch, bool)
        self.xhat, self.P = np.zeros((nx, batch)), np.zeros((nx, nx, batch))
        self.memory, self._first = np.zeros((memory[0], batch)), memory[1]
        self.begin(np.ones(batch, bool))

    def begin(self, rows: np.ndarray) -> None:
        """Replace the streams of a mask (batch,) by new ones."""
        data, rng = self.data, self.rng
        for i in np.flatnonzero(rows):
            # A random record at a random noise level, from its prior.
            record = rng.integers(len(data.x))
            low, high = np.log(NOISE)
            self.factor[i] = 1 if rng.random() < NOMINAL else np.exp(rng.uniform(low, high))
            self.xhat[:, i], position = data.mean[record], 0
            if rng.random() < MIDDLE:  # or from a smoothed state within the record
                position = rng.integers(len(data.t) - self.chunk + 1)
                draw = rng.standard_normal(len(self.xhat)) * np.sqrt(np.diag(data.cov[record]))
                self.xhat[:, i] = data.x[record, position] + draw
            self.record[i], self.position[i] = record, position
            self.P[..., i], self.memory[:, i], self.new[i] = data.cov[record], self._first, True

    def roll(self, weights: Weights) -> tuple[list[FilterState], torch.Tensor]:
        """Roll out all streams over one chunk.

        Returns:
            The estimates after each sample, and the scaled errors (chunk, nx, batch).
        """
        state = FilterState(*(torch.from_numpy(a) for a in (self.xhat, self.P, self.memory)))
        # Fresh output noise, whose level R reports to the gain.
        noise = self.rng.standard_normal((self.chunk, len(self.std), len(self.record)))
        noise *= self.std[:, None] * self.factor
        R = torch.from_numpy(np.diag(self.std**2)[..., None] * self.factor**2)
        states, errors = [], []
        for k in range(self.chunk):
            now = self.position + k
            state = self._advance(state, now, k == 0)
            y = self.data.y[self.record, now].T + noise[k]
            at = self.data.t[now], self.data.u[self.record, now]
            state = update(self.model, weights, state, at, torch.from_numpy(y), R)
            states.append(state)
            x = torch.from_numpy(np.ascontiguousarray(self.data.x[self.record, now].T))
            error = self.model.system.state_residual(state.xhat.T, x.T).T
            errors.append(error / self.model.scale)
        return states, torch.stack(errors)

    def _advance(self, state: FilterState, now: np.ndarray, first: bool) -> FilterState:
        """Predict to the samples ``now`` (batch,), except new streams at their first sample."""
        before = np.maximum(now - 1, 0)  # the result of a new stream's step is discarded
        after = before + 1
        t, u = self.data.t, self.data.u
        inputs = u[self.record, before], u[self.record, after]
        predicted = predict(self.model, state, (t[before], t[after]), inputs)
        if not first or not self.new.any():
            return predicted
        new = torch.from_numpy(self.new.copy())
        xhat = torch.where(new, state.xhat, predicted.xhat)
        return FilterState(xhat, torch.where(new, state.P, predicted.P), state.memory)

    def continue_from(self, last: FilterState) -> None:
        """Continue from the estimates at the end of a chunk.

        Random streams, those at the end of their record, and diverged ones are replaced.
        """
        self.xhat, self.P = last.xhat.detach().numpy().copy(), last.P.detach().numpy().copy()
        self.memory = last.memory.detach().numpy().copy()
        x = self.data.x[self.record, self.position + self.chunk - 1].T
        self.new[:] = False
        self.position += self.chunk
        over = self.position + self.chunk > len(self.data.t)
        error = self.model.system.state_residual(self.xhat.T, x.T).T
        error = abs(error) / self.model.scale.numpy()
        sound = (error < _FAR).all(axis=0) & np.isfinite(self.P).all(axis=(0, 1))
        self.begin((self.rng.random(len(over)) < RESTART) | over | ~sound)

    def state(self) -> dict[str, Any]:
        """Return all that `load_state` needs."""
        arrays = {n: getattr(self, n) for n in _ARRAYS}
        return {"arrays": arrays, "rng": self.rng.bit_generator.state}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`."""
        for name in _ARRAYS:
            setattr(self, name, state["arrays"][name].copy())
        self.rng.bit_generator.state = state["rng"]


_ARRAYS = ("record", "position", "factor", "new", "xhat", "P", "memory")
