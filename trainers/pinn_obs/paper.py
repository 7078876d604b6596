"""The paper's recipe: Adam on a random part of the samples, in torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.network import Architecture, Network
from pinnobs_gym.record import Record
from pinnobs_gym.system import System
from trainers.pinn_obs.config import Config
from trainers.pinn_obs.run import Run


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a record, as the loss takes them."""

    t: Tensor
    """Times in s, shape (1 + num_samples,): first t₀, then those of the samples."""
    xhat0: Tensor
    """Initial estimate at t₀, shape (nx,)."""
    u: Tensor
    """Inputs, shape (num_samples, nu)."""
    y: Tensor
    """Outputs, shape (num_samples, ny); zero where they are missing."""
    missing: Tensor | None
    """Which outputs are missing, shape (num_samples, ny); None if none is."""

    @staticmethod
    def of(system: System, record: Record, chosen: np.ndarray, dtype: torch.dtype) -> Samples:
        """The chosen samples (num_samples,) of a record of one episode."""
        t, y = record.t[chosen], record.y[0, chosen]
        u = record.u[0, chosen] if system.measured_input else np.asarray(system.input(t))
        missing = np.isnan(y)
        return Samples(
            torch.as_tensor(np.append(record.t[0], t), dtype=dtype),
            torch.as_tensor(record.prior.mean[0], dtype=dtype),
            torch.as_tensor(u, dtype=dtype),
            torch.as_tensor(np.where(missing, 0.0, y), dtype=dtype),
            torch.as_tensor(missing) if missing.any() else None,
        )


def loss_terms(network: Network, system: System, samples: Samples) -> Tensor:
    """The three terms of the loss, (3,), without their weights.

    - MSE₀ = ‖x̂(t₀) − x̂₀‖². Equation (7) writes the norm without the square. The square is taken
      because the paper names it a mean squared error, and because a bare norm has a gradient of
      length one however small the error, so that a constant step never settles on x̂₀.
    - MSE_g = mean ‖dx̂/dt − f(t, x̂, u) − L(t)(y − h(x̂))‖², equations (e55) and (8), with h(x̂) for
      the paper's Cx̂.
    - MSE_y = mean ‖h(x̂) − y‖², equation (9).

    Norms are summed over components, in the system's own units. A missing output counts as a zero
    innovation, and MSE_y is the mean over those that are there, times ny.
    """
    xhat, L, rate = network.with_rate(samples.t)
    initial = xhat[0] - samples.xhat0
    xhat, L, rate = xhat[1:], L[1:], rate[1:]
    innovation = samples.y - system.h(xhat)
    there = float(len(innovation))
    if samples.missing is not None:
        innovation = torch.where(samples.missing, 0.0, innovation)
        there = max(float((~samples.missing).sum()) / samples.y.shape[1], 1e-9)
    correction = (L * innovation[:, None, :]).sum(-1)
    residual = rate - system.f(samples.t[1:], xhat, samples.u) - correction
    return torch.stack(
        [
            (initial * initial).sum(),
            (residual * residual).sum() / len(residual),
            (innovation * innovation).sum() / there,
        ]
    )


class PaperRun(Run):
    """Adam on all training samples at once, the terms' weights those of the config."""

    def _architecture(self) -> Architecture:
        config, system = self.config, self.system
        sizes = (system.nx, system.ny, config.depth, config.width)
        architecture = Architecture(*sizes, config.activation, config.dtype)
        self._samples, self._held_out = _split(system, config, self.record, architecture)
        weights = torch.tensor([config.w0, config.w_ode, config.w_y])
        self._weights = weights.to(architecture.torch_dtype)
        return architecture

    def _draw(self, generator: torch.Generator) -> None:
        self._network = Network(self.architecture, generator)
        rate = self.config.learning_rate
        self._optimiser = torch.optim.Adam(self._network.parameters(), lr=rate, fused=True)
        self._terms: Tensor | None = None

    def step(self) -> None:
        terms = loss_terms(self._network, self.system, self._samples)
        loss = (self._weights * terms).sum()
        value = loss.item()
        self.iteration += 1
        if not math.isfinite(value):
            self.restart()
            self._terms = terms.detach()
            return
        if self.best is None or value < self.best.loss:
            weights = {k: v.clone() for k, v in self._network.state_dict().items()}
            self._found(value, weights)
        self._terms = terms.detach()
        self._optimiser.zero_grad()
        loss.backward()
        self._optimiser.step()

    def terms(self) -> np.ndarray:
        assert self._terms is not None
        return self._terms.double().numpy()

    def held_out(self) -> float | None:
        if self._held_out is None:
            return None
        with torch.no_grad():
            terms = loss_terms(self._network, self.system, self._held_out)
            return float((self._weights * terms).sum())

    def network(self) -> Network:
        assert self.best is not None
        network = Network(self.architecture)
        network.load_state_dict(dict(self.best.weights))
        return network

    def loss(self) -> float:
        assert self.best is not None
        return self.best.loss

    def _state(self) -> dict[str, Any]:
        network, optimiser = self._network.state_dict(), self._optimiser.state_dict()
        return {"network": network, "optimiser": optimiser}

    def _take_up(self, state: Mapping[str, Any]) -> None:
        self._network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])


def _split(
    system: System, config: Config, record: Record, architecture: Architecture
) -> tuple[Samples, Samples | None]:
    """A random part of the samples in the order of time, and those left."""
    count = max(1, round(config.train_fraction * record.num_samples))
    order = np.random.default_rng(config.seed).permutation(record.num_samples)
    dtype = architecture.torch_dtype
    chosen, left = np.sort(order[:count]), np.sort(order[count:])
    samples = Samples.of(system, record, chosen, dtype)
    return samples, Samples.of(system, record, left, dtype) if len(left) else None
