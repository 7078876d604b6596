"""An EKF of one episode by a jitted function of JAX that processes one sample."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from kernel_figures.jax_peers import flow, jax, jnp, output
from kernel_figures.steps import matrices

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record


def jax_ekf(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
    """Return a call whose result is the estimates (num_samples, nx) of the record's first episode,
    which a caller of JAX has after each sample as arrays of NumPy."""
    dt = float(record.t[1] - record.t[0])
    moved, h, (Q, R) = flow(ekf, dt), output(ekf), matrices(ekf, dt)
    samples = list(zip(record.t.tolist(), record.y[0], strict=True))
    mean, cov = record.prior.mean[0], record.prior.cov[0]

    def corrected(x: Any, P: Any, t: Any, y: Any) -> tuple[Any, Any]:
        H = jax.jacfwd(h)(x, t)
        S = H @ P @ H.T + R
        K = jnp.linalg.solve(S, H @ P).T
        M = jnp.eye(len(x)) - K @ H
        return x + K @ (y - h(x, t)), M @ P @ M.T + K @ R @ K.T

    def step(x: Any, P: Any, before: Any, t: Any, y: Any) -> tuple[Any, Any]:
        F = jax.jacfwd(moved)(x, before, t - before)
        return corrected(moved(x, before, t - before), F @ P @ F.T + Q, t, y)

    first, later = jax.jit(corrected), jax.jit(step)

    def play() -> np.ndarray:
        xhat, x, P, before = [], mean, cov, None
        for t, y in samples:
            x, P = first(x, P, t, y) if before is None else later(x, P, before, t, y)
            before = t
            xhat.append(np.asarray(x))
        return np.array(xhat)

    return play
