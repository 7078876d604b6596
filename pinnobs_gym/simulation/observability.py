"""Which states the outputs of an episode can tell, and how well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.matrices import product
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import Setup, System, initial_states, output_scale, vector

TRAJECTORIES = 16
"""Number of trajectories at which a plant is linearised."""
_BLOCK = 64
"""Number of rows that are added to a triangular factor at a time, at least."""
_RANK = 1e-8
"""Singular value, relative to the largest, below which a direction is not seen; rounding errors of
a product of many Jacobians are smaller."""
_IN_KERNEL = 1e-3
"""Length of a state's part in directions that are not seen, from which it is named."""


@dataclass(frozen=True, eq=False)
class Observability:
    """What the outputs of an episode tell of the initial state, linearised at some trajectories."""

    rank: np.ndarray
    """Rank of the observability Gramian of each trajectory, shape (num_trajectories,)."""
    condition: np.ndarray
    """Its condition number, in scaled states, shape (num_trajectories,); infinite below full
    rank."""
    unseen: tuple[str, ...]
    """States that act on no output along any trajectory."""
    mixed: tuple[str, ...]
    """Other states that the outputs see only in combination along all trajectories."""
    prior_std: np.ndarray
    """Standard deviation of the prior, in state units, shape (nx,)."""
    left: np.ndarray
    """Part of it that the outputs leave, 0 to 1, shape (num_trajectories, nx); NaN of a state that
    the prior knows exactly."""


def observability(system: System, setup: Setup) -> Observability:
    """Return the observability of a system along the trajectories of 16 initial states of a setup,
    the same at every call. They are drawn from the prior where the initial state is fixed, which
    may be a special one, such as a state of rest.

    The observability Gramian is G = ΣΦᵀHᵀR⁻¹HΦ over the samples of an episode, with the Jacobian Φ
    of the state at a sample by the initial state, in units of `System.scale` (Kailath 1980, section
    9.2; Krener & Ide 2009 for nonlinear plants). R is that of the output noise, or the square of
    the outputs' scale where there is none. Process noise is left out. Given the outputs, the
    covariance of the initial state is (P₀⁻¹ + G)⁻¹.

    The rank is that of the rows HΦ, each divided by the norms of H and Φ, relative to which their
    rounding errors are small, however much the plant expands or contracts.

    Args:
        system: the plant.
        setup: its episodes.

    Raises:
        ValueError: in one line, if too few initial states are admissible.
    """
    nx = system.nx
    root, even = _factors(system, setup, _starts(system, setup))
    seen, kernel = _kernels(even)
    # Rounding errors must not look like information on what is not seen.
    root = root - root @ kernel @ kernel.swapaxes(1, 2)
    rank = seen.sum(axis=1)
    size = np.linalg.svd(root, compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.where(rank == nx, (size[:, 0] / size[:, -1]) ** 2, np.inf)
    part = np.sqrt((kernel**2).sum(axis=2)).min(axis=0)
    whole = part > 1 - _IN_KERNEL**2
    names = np.array(system.state_names)
    mixed = names[(part > _IN_KERNEL) & ~whole]
    std, left = _left(system, setup, root)
    return Observability(rank, condition, tuple(names[whole]), tuple(mixed), std, left)


def _starts(system: System, setup: Setup) -> np.ndarray:
    """Return initial states, (num_trajectories, nx)."""
    if not setup.fixed_x0:
        return initial_states(system, setup, TRAJECTORIES)
    drawn = np.random.default_rng(0).standard_normal((TRAJECTORIES, system.nx))
    mean, cov = prior_moments(system, setup)
    x = mean + drawn @ _root(cov).T
    return x if system.state_box is None else system.state_box.clipped(x)


def _root(cov: np.ndarray) -> np.ndarray:
    """Return a root B (nx, nx) of a covariance BBᵀ, which may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _factors(system: System, setup: Setup, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangular factors (num_trajectories, nx, nx) of the Gramian and of the sum of the
    squares of the rows HΦ over the norms of H and Φ, along the trajectories of states x
    (num_trajectories, nx)."""
    batch, nx = x.shape
    t, scale = setup.times[: setup.num_steps], vector(system.scale, nx, "scale")
    u = np.broadcast_to(np.asarray(system.input(t)), (batch, len(t), system.nu))
    if system.draws_input:
        system = replace(system, measured_input=True)
        rng = np.random.default_rng(0)
        u = np.stack([system.draw_input(rng, t) for _ in range(batch)])
    noise = system.noise(setup.noise_std, setup.process_noise)
    flow = np.broadcast_to(np.eye(nx), (batch, nx, nx))
    factors: list[Any] = [np.zeros((batch, 0, nx))] * 2
    rows: list[list[np.ndarray]] = [[], []]
    with np.errstate(all="ignore"):  # a trajectory that diverges has no rows from there on
        for k, now in enumerate(t.tolist()):
            if k:
                before = float(t[k - 1])
                x, F = model_step_jacobian(system, before, now, x, u[:, k - 1], u[:, k])
                flow = _times(F * (scale / scale[:, None]), flow)
            H = _whitening(system, noise, now) @ (system.h_jacobian(now, x, u[:, k]) * scale)
            added = _times(H, flow)
            finite = np.isfinite(added).all(axis=(1, 2), keepdims=True)
            norms = np.linalg.norm(flow, axis=(1, 2), keepdims=True)
            norms = norms * np.linalg.norm(H, axis=2, keepdims=True)
            rows[0].append(np.where(finite, added, 0.0))
            rows[1].append(np.where(finite & (norms > 0), added / norms, 0.0))
            if len(rows[0]) * system.ny >= max(_BLOCK, nx) or k == len(t) - 1:
                factors = [
                    np.linalg.qr(np.concatenate([R, *each], axis=1), mode="r")
                    for R, each in zip(factors, rows, strict=True)
                ]
                rows = [[], []]
    missing = max(0, nx - factors[0].shape[1])  # of an episode with fewer rows than states
    root, even = (np.pad(R, ((0, 0), (0, missing), (0, 0))) for R in factors)
    return root, even


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products (batch, n, m) of matrices (batch, n, k) and (batch, k, m)."""
    inside = (np.ascontiguousarray(each.transpose(1, 2, 0)) for each in (a, b))
    return product(*inside).transpose(2, 0, 1)


def _whitening(system: System, noise: Noise, t: float) -> np.ndarray:
    """Return a root W (ny, ny) of R⁻¹ = WᵀW at a time; outputs without noise have their scale."""
    R = noise.R(t)[..., 0]
    R = R + np.diag(np.where(np.diag(R) > 0, 0.0, output_scale(system) ** 2))
    values, vectors = np.linalg.eigh(R)
    return (vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))).T


def _kernels(factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which singular directions of triangular factors (num_trajectories, nx, nx) are seen,
    bool (num_trajectories, nx), and those that are not, columns of (num_trajectories, nx, nx) of
    which the others are zero."""
    _, values, directions = np.linalg.svd(factors)
    seen = values > _RANK * np.maximum(values[:, :1], np.finfo(float).tiny)
    return seen, np.where(seen[:, None, :], 0.0, directions.swapaxes(1, 2))


def _left(system: System, setup: Setup, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviations of the prior (nx,), and what is left of them given information
    with these factors, (num_trajectories, nx)."""
    scale = vector(system.scale, system.nx, "scale")
    cov = prior_moments(system, setup)[1]
    std = np.sqrt(np.diag(cov))
    # With P₀ = BBᵀ, (P₀⁻¹ + G)⁻¹ = B(I + BᵀGB)⁻¹Bᵀ, also where P₀ is singular.
    B = _root(cov / scale / scale[:, None])
    _, size, directions = np.linalg.svd(root @ B)
    spread = (B @ directions.swapaxes(1, 2)) / np.hypot(1.0, size)[:, None, :]
    with np.errstate(invalid="ignore", divide="ignore"):
        return std, np.sqrt((spread**2).sum(axis=2)) * scale / std
