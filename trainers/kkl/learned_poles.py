"""Training of the poles of z together with a small T*."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_maps import Mlp, Scaling
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.truth import truth

EPISODES = 200
"""Largest number of episodes from which windows are drawn."""
STEPS = 400
"""Number of steps of Adam."""
MEMORY = 6.0
"""Length of the windows of outputs, over the slowest initial time constant."""
_BATCH, _WIDTH, _RATE = 128, 24, 1e-2
_LONGEST = 400


def learn(
    system: System,
    poles: Sequence[float],
    t: np.ndarray,
    noise_std: np.ndarray,
    x0: np.ndarray,
    seed: int,
) -> tuple[float, ...]:
    """Train real poles together with a small network that maps z to x, by Adam.

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

    Returns:
        The poles in 1/s.

    Raises:
        ValueError: in one line, if an initial pole is not negative.
    """
    sizes = -np.asarray(poles, dtype=float)
    if not (sizes > 0).all():
        raise ValueError(f"A_z is not Hurwitz: poles={tuple(poles)}; expected all below 0")
    # Simulated episodes: scaled states and outputs.
    h = float(np.diff(t).mean())
    window = min(int(np.ceil(MEMORY / sizes.min() / h)), len(t) // 2, _LONGEST)
    x = truth(system, x0[:EPISODES], t, system.setups["benchmark"].truth_step)
    scale = vector(system.scale, system.nx, "scale")
    states = torch.tensor((x - x.mean(axis=(0, 1))) / scale)
    y = torch.tensor(system.h(t[:, None], x, np.asarray(system.input(t))[:, None]))
    # The network and the logarithms of the poles, with one optimiser.
    generator = torch.Generator().manual_seed(seed)
    ny, number = system.ny, len(sizes)
    logs = torch.tensor(np.log(sizes), requires_grad=True)
    inputs, outputs = (Scaling(np.zeros(n), np.eye(n)) for n in (ny * number, system.nx))
    net = Mlp(inputs, outputs, 2, _WIDTH, "tanh", generator)
    adam = torch.optim.Adam([*net.parameters, logs], _RATE)
    std = torch.tensor(noise_std)
    steps = torch.arange(window + 1)
    for step in range(STEPS):
        for group in adam.param_groups:
            group["lr"] = _RATE * 0.5 * (1 + np.cos(np.pi * step / STEPS))
        # A batch of windows, each ending at a sample k of an episode i, with fresh noise.
        k = torch.randint(window, len(t), (_BATCH,), generator=generator)
        i = torch.randint(x.shape[1], (_BATCH,), generator=generator)
        windows = y[k[:, None] - window + steps, i[:, None]]
        noise = torch.randn(windows.shape, generator=generator, dtype=windows.dtype)
        windows = windows + std * noise
        # z at the end of each window, standardised over the batch, and the network's error.
        z = torch.einsum("pw,bwo->bop", response(logs, h, window), windows).reshape(_BATCH, -1)
        z = (z - z.mean(0)) / z.std(0)
        loss = (net(z) - states[k, i]).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return tuple((-torch.exp(logs.detach())).tolist())


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
