"""Filters of JAX libraries for a system, as functions of a record."""

from __future__ import annotations

import os

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.traced_code import Trace

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")


def function(system: System, name: str) -> Callable[..., Any]:
    """Return f, h or the input of a system as a function of t, x and u in JAX."""
    trace = Trace(system, name)

    def stack(x: Any, *components: Any) -> Any:
        return jnp.stack([jnp.asarray(c, dtype=float) for c in components])

    if not trace.values:
        return lambda t, x, u: jnp.zeros(0)
    names: dict[str, Any] = {"np": jnp, "stack": stack}
    code = trace.source([trace.values], "vector")
    exec(compile(code, "<jax>", "exec"), names)
    return lambda t, x, u: names["function"](system, t, x, u)


def dynamax_ekf(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
    """Return a call of dynamax's EKF, jitted and over the batch, whose result is the estimates
    (batch, num_samples, nx)."""
    system, dt = ekf.system, float(record.t[1] - record.t[0])
    f, h, given = (function(system, name) for name in ("f", "h", "input"))
    steps = max(1, round(float(np.ceil(dt / longest_step(system) - 1e-6))))

    def flow(x: Any, u: Any) -> Any:
        part = dt / steps
        for i in range(steps):
            t = u[0] + i * part
            inputs = [given(t + c * part, x, None) for c in (0.0, 0.5, 1.0)]
            k1 = f(t, x, inputs[0])
            k2 = f(t + part / 2, x + part / 2 * k1, inputs[1])
            k3 = f(t + part / 2, x + part / 2 * k2, inputs[1])
            k4 = f(t + part, x + part * k3, inputs[2])
            x = x + part / 6 * (k1 + 2 * (k2 + k3) + k4)
        return x

    L, R = ekf.noise.L(0.0)[..., 0], ekf.noise.R(0.0)[..., 0]

    def one(mean: Any, cov: Any, y: Any, t: Any) -> Any:
        parameters = ParamsNLGSSM(
            initial_mean=mean,
            initial_covariance=cov,
            dynamics_function=flow,
            dynamics_covariance=jnp.asarray(dt * L @ L.T),
            emission_function=lambda x, u: h(u[0], x, given(u[0], x, None)),
            emission_covariance=jnp.asarray(R),
        )
        fields = ["filtered_means", "filtered_covariances"]
        found = extended_kalman_filter(parameters, y, t[:, None], output_fields=fields)
        return found.filtered_means, found.filtered_covariances

    whole = jax.jit(jax.vmap(one, in_axes=(0, 0, 0, None)))
    arrays = [jnp.asarray(a) for a in (record.prior.mean, record.prior.cov, record.y, record.t)]

    def call() -> np.ndarray:
        means, covariances = whole(*arrays)
        covariances.block_until_ready()
        return np.asarray(means)

    return call
