"""Poles learned together with a small T*."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_maps import Mlp, Scaling
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.truth import truth

EPISODES = 200
"""Most episodes that windows are taken from."""
STEPS = 400
"""Steps of Adam."""
MEMORY = 6.0
"""Length of the outputs that z is computed from, over the slowest time constant to begin with."""
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
    """Real poles from which a small network finds x best, by Adam on both together.

    z is the exact response, from rest, to windows of sampled outputs with their noise; its
    derivative by a pole is automatic differentiation's. The logarithms of the poles' sizes are what
    moves: they stay stable.

    Args:
        system: the plant.
        poles: to begin with, in 1/s, all negative, for each output.
        t: sample times in s, (num_samples,), taken as regular.
        noise_std: standard deviation of the output noise, (ny,).
        x0: initial states of simulated episodes, (batch, nx).
        seed: what windows, noise and the network are drawn from.

    Raises:
        ValueError: in one line, if a pole is not negative.
    """
    sizes = -np.asarray(poles, dtype=float)
    if not (sizes > 0).all():
        raise ValueError(f"A_z is not Hurwitz: poles={tuple(poles)}; expected all below 0")
    h = float(np.diff(t).mean())
    window = min(int(np.ceil(MEMORY / sizes.min() / h)), len(t) // 2, _LONGEST)
    x = truth(system, x0[:EPISODES], t, system.setups["benchmark"].truth_step)
    scale = vector(system.scale, system.nx, "scale")
    states = torch.tensor((x - x.mean(axis=(0, 1))) / scale)
    y = torch.tensor(system.h(t[:, None], x, np.asarray(system.input(t))[:, None]))
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
        k = torch.randint(window, len(t), (_BATCH,), generator=generator)
        i = torch.randint(x.shape[1], (_BATCH,), generator=generator)
        seen = y[k[:, None] - window + steps, i[:, None]]
        seen = seen + std * torch.randn(seen.shape, generator=generator, dtype=seen.dtype)
        z = torch.einsum("pw,bwo->bop", _response(logs, h, window), seen).reshape(_BATCH, -1)
        z = (z - z.mean(0)) / z.std(0)
        loss = (net(z) - states[k, i]).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return tuple((-torch.exp(logs.detach())).tolist())


def _response(logs: Tensor, h: float, window: int) -> Tensor:
    """Weights (poles, window + 1) of outputs in z at the last of them, exact for outputs joined by
    straight lines, z being 0 at the first."""
    rate = torch.exp(logs)[:, None]
    flow = torch.exp(-rate * h)
    now = 1 - (1 - flow) / (rate * h)
    before = 1 - flow - now
    left = torch.exp(-rate * h * torch.arange(window - 1, -1, -1))  # of each interval's response
    nothing = torch.zeros_like(rate)
    return torch.cat([left * before, nothing], 1) + torch.cat([nothing, left * now], 1)
