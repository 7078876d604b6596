"""The learned gains run over a batch of streams in torch, so that losses have gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.kalman import kalman_gain, update_with
from pinnobs_gym.estimation.learned.gain_network import (
    Variant,
    corrected_gain,
    recurrent_gain,
    remembered,
)
from pinnobs_gym.simulation.matrices import sandwich
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.system import System

Weights = Sequence[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Model:
    """What all steps of a rollout share."""

    system: System
    variant: Variant
    scale: Tensor
    """Shape (nx, 1)."""
    output_scale: Tensor
    """Shape (ny, 1)."""
    Q: Tensor
    """Covariance of the process noise of a sample, shape (nx, nx, 1)."""


@dataclass(frozen=True)
class FilterState:
    """The estimates of all streams after a sample, the batch last."""

    xhat: Tensor
    """Shape (nx, batch)."""
    P: Tensor
    """Shape (nx, nx, batch); carried along unchanged by the variant without a covariance."""
    memory: Tensor
    """Shape (memory size, batch)."""


def predict(
    model: Model,
    moment: FilterState,
    t: tuple[np.ndarray, np.ndarray],
    u: tuple[np.ndarray, np.ndarray],
) -> FilterState:
    """The prediction over one sample, from times t[0] to t[1], (batch,) in s, at inputs u[0] and
    u[1], (batch, nu).

    The derivative of the step is its exact Jacobian, which the covariance needs anyway. That the
    Jacobian itself depends on x̂ is left out of gradients: the points of linearisation are fixed.
    """
    at = moment.xhat.detach()
    x = np.ascontiguousarray(at.numpy().T)
    after, F = model_step_jacobian(model.system, t[0], t[1], x, u[0], u[1])
    flow = torch.from_numpy(np.ascontiguousarray(F.transpose(1, 2, 0)))
    moved = (flow * (moment.xhat - at)[None]).sum(1)
    xhat = torch.from_numpy(np.ascontiguousarray(after.T)) + moved
    return FilterState(xhat, sandwich(flow, moment.P) + model.Q, moment.memory)


def update(
    model: Model,
    weights: Weights,
    moment: FilterState,
    now: tuple[np.ndarray, np.ndarray],
    y: Tensor,
    R: Tensor,
) -> FilterState:
    """The estimates after outputs y (ny, batch), with noise of covariance R (ny, ny, batch), at
    times ``now[0]`` (batch,) in s and inputs ``now[1]`` (batch, nu); no output is missing."""
    xhat, P = moment.xhat, moment.P
    at = xhat.detach()
    (t, u), x = now, at.numpy().T
    H = np.broadcast_to(model.system.h_jacobian(t, x, u), (len(x), len(y), len(xhat)))
    H = torch.from_numpy(np.array(H.transpose(1, 2, 0), order="C"))
    predicted = torch.from_numpy(np.array(model.system.h(t, x, u).T, order="C"))
    innovation = y - predicted - (H * (xhat - at)[None]).sum(1)
    if model.variant == "gru":
        std = torch.diagonal(R).T.sqrt()
        sizes = model.scale, model.output_scale
        K, memory = recurrent_gain(weights, *sizes, xhat, innovation, std, moment.memory)
        return FilterState(xhat + (K * innovation[None]).sum(1), P, memory)
    K, S = kalman_gain(P, H, R)
    variance = torch.diagonal(S).T
    share = 1 - torch.diagonal(R).T / variance
    args = (xhat, P, innovation, variance, K, share, moment.memory)
    K = corrected_gain(weights, model.scale, *args)
    present = torch.ones_like(innovation, dtype=torch.bool)
    memory = remembered(moment.memory, innovation, variance, present)
    x_after, P = update_with(K, xhat.T, P, innovation.T, H, R)
    return FilterState(x_after.T, P, memory)
