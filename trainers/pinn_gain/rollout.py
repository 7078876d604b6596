"""Differentiable rollout of the learned gains over a batch of streams, in torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.gain_network import (
    Variant,
    recurrent_gain,
    update_with_network,
)
from pinnobs_gym.simulation.matrices import sandwich
from pinnobs_gym.simulation.model import model_step_moments
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.system import System

Weights = Sequence[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Model:
    """The constants of a rollout."""

    system: System
    variant: Variant
    scale: Tensor
    """The system's scale, shape (nx, 1)."""
    output_scale: Tensor
    """Scale of the outputs, shape (ny, 1)."""
    noise: Noise
    """The noise that filters assume."""


@dataclass(frozen=True)
class FilterState:
    """The estimates of all streams after a sample; the batch is the last axis."""

    xhat: Tensor
    """Estimates, shape (nx, batch)."""
    P: Tensor
    """Covariances, shape (nx, nx, batch); updates of the variant ``gru`` leave them unchanged."""
    memory: Tensor
    """Memory of the network, shape (memory size, batch)."""


def predict(
    model: Model,
    state: FilterState,
    t: tuple[np.ndarray, np.ndarray],
    u: tuple[np.ndarray, np.ndarray],
) -> FilterState:
    """Predict over one sample, from times t[0] to t[1], (batch,) in s, with inputs u[0] and u[1],
    (batch, nu).

    Gradients pass through the exact Jacobian of the model's step, which the covariance needs, too.
    Its own dependence on x̂ is neglected in gradients.
    """
    # The step and its Jacobian in NumPy.
    at = state.xhat.detach()
    x = np.ascontiguousarray(at.numpy().T)
    after, F, Q = model_step_moments(model.system, model.noise, t[0], t[1], x, u[0], u[1])
    flow = torch.from_numpy(np.ascontiguousarray(F))
    # Zero in value; its gradient is the Jacobian.
    moved = (flow * (state.xhat - at)[None]).sum(1)
    xhat = torch.from_numpy(np.ascontiguousarray(after.T)) + moved
    return FilterState(xhat, sandwich(flow, state.P) + torch.from_numpy(Q), state.memory)


def update(
    model: Model,
    weights: Weights,
    state: FilterState,
    now: tuple[np.ndarray, np.ndarray],
    y: Tensor,
    R: Tensor,
) -> FilterState:
    """Update the estimates by outputs, none of which is missing.

    Args:
        model: the constants of the rollout.
        weights: weights and biases of the network.
        state: the predictions.
        now: times (batch,) in s, and inputs (batch, nu).
        y: outputs, shape (ny, batch).
        R: covariance of the output noise, shape (ny, ny, batch).
    """
    # Innovation; its gradient passes through H, as in `predict`.
    xhat, P = state.xhat, state.P
    at = xhat.detach()
    (t, u), x = now, at.numpy().T
    H = np.broadcast_to(model.system.h_jacobian(t, x, u), (len(x), len(y), len(xhat)))
    H = torch.from_numpy(np.array(H.transpose(1, 2, 0), order="C"))
    predicted = torch.from_numpy(np.array(model.system.h(t, x, u).T, order="C"))
    innovation = model.system.output_residual(y.T, predicted.T).T
    innovation = innovation - (H * (xhat - at)[None]).sum(1)
    seen = nearest(xhat.T, 0.0, model.system.state_period).T  # angles within a period
    if model.variant == "gru":
        std = torch.diagonal(R).T.sqrt()
        sizes = model.scale, model.output_scale
        K, memory = recurrent_gain(weights, *sizes, seen, innovation, std, state.memory)
        return FilterState(xhat + (K * innovation[None]).sum(1), P, memory)
    present = torch.ones_like(innovation, dtype=torch.bool)
    after, P, _, memory = update_with_network(
        weights, model.scale, seen, P, innovation, H, R, state.memory, present
    )
    if model.system.state_period is not None:
        after = after + (xhat - seen)
    return FilterState(after, P, memory)
