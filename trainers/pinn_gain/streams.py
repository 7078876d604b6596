"""The streams that a gain is trained on: pieces of smoothed records, measured anew."""

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
"""Part of the streams with the noise that training was told."""
NOISE = (0.3, 8.0)
"""Range of the noise of the others, over that; its logarithm is uniform."""
MIDDLE = 0.05
"""Part of the new streams that begin amid a record, at a draw from N(x, P₀)."""
RESTART = 0.5
"""Probability that a stream begins anew after a chunk."""
_FAR = 5.0
"""Scaled error of an estimate over which its stream begins anew."""


@dataclass(frozen=True)
class Data:
    """Smoothed records of one prior."""

    t: np.ndarray
    """Sample times in s, shape (num_samples,)."""
    x: np.ndarray
    """Smoothed trajectories, shape (records, num_samples, nx)."""
    y: np.ndarray
    """Their outputs, shape (records, num_samples, ny)."""
    u: np.ndarray
    """Inputs, shape (records, num_samples, nu)."""
    mean: np.ndarray
    """x̂₀, shape (records, nx)."""
    cov: np.ndarray
    """P₀, shape (records, nx, nx)."""

    @staticmethod
    def of(system: System, record: Record, smoothed: Smoothed, rows: np.ndarray) -> Data:
        """Those of some rows."""
        x = smoothed.xhat[rows]
        prior = record.prior
        u = record.u[rows]
        y = system.h(record.t, x, u)
        return Data(record.t, x, y, u, prior.mean[rows], prior.cov[rows])


class Streams:
    """The running state of all streams, and what chance gives them.

    Args:
        model: what is rolled out.
        data: what is learned from.
        std: standard deviations of the output noise that is told, shape (ny,).
        batch: number of streams.
        chunk: samples of a chunk.
        memory: size and first value of what the network remembers.
        seed: of all that chance decides.
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
        """Begin the streams of a mask (batch,) anew."""
        data, rng = self.data, self.rng
        for i in np.flatnonzero(rows):
            record = rng.integers(len(data.x))
            low, high = np.log(NOISE)
            self.factor[i] = 1 if rng.random() < NOMINAL else np.exp(rng.uniform(low, high))
            self.xhat[:, i], position = data.mean[record], 0
            if rng.random() < MIDDLE:
                position = rng.integers(len(data.t) - self.chunk + 1)
                draw = rng.standard_normal(len(self.xhat)) * np.sqrt(np.diag(data.cov[record]))
                self.xhat[:, i] = data.x[record, position] + draw
            self.record[i], self.position[i] = record, position
            self.P[..., i], self.memory[:, i], self.new[i] = data.cov[record], self._first, True

    def roll(self, weights: Weights) -> tuple[list[FilterState], torch.Tensor]:
        """All streams over one chunk: the estimates after each sample, and the scaled errors
        (chunk, nx, batch)."""
        moment = FilterState(*(torch.from_numpy(a) for a in (self.xhat, self.P, self.memory)))
        noise = self.rng.standard_normal((self.chunk, len(self.std), len(self.record)))
        noise *= self.std[:, None] * self.factor
        R = torch.from_numpy(np.diag(self.std**2)[..., None] * self.factor**2)
        moments, errors = [], []
        for k in range(self.chunk):
            now = self.position + k
            moment = self._advance(moment, now, k == 0)
            y = self.data.y[self.record, now].T + noise[k]
            at = self.data.t[now], self.data.u[self.record, now]
            moment = update(self.model, weights, moment, at, torch.from_numpy(y), R)
            moments.append(moment)
            x = torch.from_numpy(np.ascontiguousarray(self.data.x[self.record, now].T))
            errors.append((moment.xhat - x) / self.model.scale)
        return moments, torch.stack(errors)

    def _advance(self, moment: FilterState, now: np.ndarray, first: bool) -> FilterState:
        """The prediction to samples now (batch,); a new stream is at its own already."""
        before = np.maximum(now - 1, 0)  # what comes of a new stream's step is dropped
        after = before + 1
        t, u = self.data.t, self.data.u
        inputs = u[self.record, before], u[self.record, after]
        predicted = predict(self.model, moment, (t[before], t[after]), inputs)
        if not first or not self.new.any():
            return predicted
        new = torch.from_numpy(self.new.copy())
        xhat = torch.where(new, moment.xhat, predicted.xhat)
        return FilterState(xhat, torch.where(new, moment.P, predicted.P), moment.memory)

    def continue_from(self, last: FilterState) -> None:
        """Go on from the estimates at the end of a chunk; some streams, those that are at an end
        and those that are lost begin anew."""
        self.xhat, self.P = last.xhat.detach().numpy().copy(), last.P.detach().numpy().copy()
        self.memory = last.memory.detach().numpy().copy()
        x = self.data.x[self.record, self.position + self.chunk - 1].T
        self.new[:] = False
        self.position += self.chunk
        over = self.position + self.chunk > len(self.data.t)
        error = abs(self.xhat - x) / self.model.scale.numpy()
        sound = (error < _FAR).all(axis=0) & np.isfinite(self.P).all(axis=(0, 1))
        self.begin((self.rng.random(len(over)) < RESTART) | over | ~sound)

    def state(self) -> dict[str, Any]:
        """All that `load_state` needs."""
        arrays = {n: getattr(self, n) for n in _ARRAYS}
        return {"arrays": arrays, "rng": self.rng.bit_generator.state}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` gave."""
        for name in _ARRAYS:
            setattr(self, name, state["arrays"][name].copy())
        self.rng.bit_generator.state = state["rng"]


_ARRAYS = ("record", "position", "factor", "new", "xhat", "P", "memory")
