"""The first phase of a training with learned poles: the poles of z, together with a small T*."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_maps import Mlp, Scaling
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.truth import truth
from trainers.adam import Adam

EPISODES = 200
"""Largest number of episodes from which windows are drawn."""
STEPS = 400
"""Number of steps of Adam."""
MEMORY = 6.0
"""Length of the windows of outputs, over the slowest initial time constant."""
_BATCH, _WIDTH, _RATE = 128, 24, 1e-2
_LONGEST = 400


class PoleSearch:
    """A training of real poles together with a small network that maps z to x, by Adam.

    z is the exact response, from z = 0, to windows of noisy output samples; its derivatives by the
    poles come from automatic differentiation. The variables are the logarithms of the poles' sizes,
    so that the poles stay stable.

    Args:
        system: the plant.
        poles: initial poles per output, in 1/s, all negative.
        t: sample times in s, shape (num_samples,), assumed to be regular.
        noise_std: standard deviation of the output noise, shape (ny,).
        x0: initial states of simulated episodes, shape (batch, nx).
        seed: seed of the windows, the noise and the network.

    Raises:
        ValueError: in one line, if an initial pole is not negative.
    """

    def __init__(
        self,
        system: System,
        poles: Sequence[float],
        t: np.ndarray,
        noise_std: np.ndarray,
        x0: np.ndarray,
        seed: int,
    ) -> None:
        sizes = -np.asarray(poles, dtype=float)
        if not (sizes > 0).all():
            raise ValueError(f"A_z is not Hurwitz: poles={tuple(poles)}; expected all below 0")
        # Simulated episodes: scaled states and outputs.
        self._h = float(np.diff(t).mean())
        self._window = min(int(np.ceil(MEMORY / sizes.min() / self._h)), len(t) // 2, _LONGEST)
        x = truth(system, x0[:EPISODES], t, system.setups["benchmark"].truth_step)
        scale = vector(system.scale, system.nx, "scale")
        self._states = torch.tensor((x - x.mean(axis=(0, 1))) / scale)
        self._y = torch.tensor(system.h(t[:, None], x, np.asarray(system.input(t))[:, None]))
        self._std = torch.tensor(noise_std)
        # The network and the logarithms of the poles, with one optimiser.
        self._generator = torch.Generator().manual_seed(seed)
        self._logs = torch.tensor(np.log(sizes), requires_grad=True)
        inputs, outputs = (
            Scaling(np.zeros(n), np.eye(n)) for n in (system.ny * len(sizes), system.nx)
        )
        self._net = Mlp(inputs, outputs, 2, _WIDTH, "tanh", self._generator)
        self._adam = Adam([*self._net.parameters, self._logs])
        self.iteration = 0
        """Number of steps so far."""
        self.loss = float("nan")
        """Mean squared scaled error of x̂ in the last batch."""

    @property
    def poles(self) -> tuple[float, ...]:
        """The poles so far, in 1/s."""
        return tuple((-torch.exp(self._logs.detach())).tolist())

    def finished(self) -> bool:
        """Return whether all steps are made."""
        return self.iteration >= STEPS

    def step(self) -> None:
        """Make a step of Adam, of a length that falls as a half cosine."""
        # A batch of windows, each ending at a sample k of an episode i, with fresh noise.
        y, window, generator = self._y, self._window, self._generator
        k = torch.randint(window, len(y), (_BATCH,), generator=generator)
        i = torch.randint(y.shape[1], (_BATCH,), generator=generator)
        windows = y[k[:, None] - window + torch.arange(window + 1), i[:, None]]
        noise = torch.randn(windows.shape, generator=generator, dtype=windows.dtype)
        windows = windows + self._std * noise
        # z at the end of each window, standardised over the batch, and the network's error.
        weights = response(self._logs, self._h, window)
        z = torch.einsum("pw,bwo->bop", weights, windows).reshape(_BATCH, -1)
        z = (z - z.mean(0)) / z.std(0)
        loss = (self._net(z) - self._states[k, i]).square().mean()
        self._adam.clear()
        loss.backward()
        self._adam.step(_RATE * 0.5 * (1 + np.cos(np.pi * self.iteration / STEPS)))
        self.iteration += 1
        self.loss = loss.item()


def response(logs: Tensor, h: float, window: int) -> Tensor:
    """Return the weights (poles, window + 1) of a window's outputs in z at its end.

    z is 0 at the window's first sample; the weights are exact for piecewise linear outputs.
    """
    rate = torch.exp(logs)[:, None]
    flow = torch.exp(-rate * h)
    now = 1 - (1 - flow) / (rate * h)
    before = 1 - flow - now
    # Decay of each interval's response until the end of the window.
    decay = torch.exp(-rate * h * torch.arange(window - 1, -1, -1))
    nothing = torch.zeros_like(rate)
    return torch.cat([decay * before, nothing], 1) + torch.cat([nothing, decay * now], 1)
