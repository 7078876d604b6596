"""Filters of JAX libraries for a system, as functions of a record. They are the extra ``peers``."""

# pyright: reportMissingImports=false

from __future__ import annotations

import os

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kernel_figures import steps
from kernel_figures.steps import matrices
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.traced_code import Trace

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")


def function(system: System, name: str) -> Callable[..., Any]:
    """Return f, h or the input of a system as a function of t, x and u in JAX."""
    trace = Trace(plant_form(system), name)

    def stack(x: Any, *components: Any) -> Any:
        return jnp.stack([jnp.asarray(c, dtype=float) for c in components])

    if not trace.values:
        return lambda t, x, u: jnp.zeros(0)
    names: dict[str, Any] = {"np": jnp, "stack": stack}
    code = trace.source([trace.values], "vector")
    exec(compile(code, "<jax>", "exec"), names)
    return lambda t, x, u: names["function"](system, t, x, u)


def flow(ekf: EKF, dt: float) -> Callable[..., Any]:
    """Return the state x after a time of at most dt in s as a function of x, the time t before and
    that time; see `kernel_figures.steps.flow`."""
    f, given = (function(ekf.system, name) for name in ("f", "input"))
    return steps.flow(ekf.system, dt, f, given)


def output(ekf: EKF) -> Callable[..., Any]:
    """Return h as a function of x and t."""
    h, given = (function(ekf.system, name) for name in ("h", "input"))
    return lambda x, t: h(t, x, given(t, x, None))


def dynamax_ekf(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
    """Return a call of dynamax's EKF, jitted and over the batch, whose result is the estimates
    (batch, num_samples, nx)."""
    dt = float(record.t[1] - record.t[0])
    moved, h, (Q, R) = flow(ekf, dt), output(ekf), matrices(ekf, dt)

    def one(mean: Any, cov: Any, y: Any, t: Any) -> Any:
        parameters = ParamsNLGSSM(
            initial_mean=mean,
            initial_covariance=cov,
            # The step to a sample is given the inputs of that sample: here its time.
            dynamics_function=lambda x, u: moved(x, u[0] - dt, dt),
            dynamics_covariance=jnp.asarray(Q),
            emission_function=lambda x, u: h(x, u[0]),
            emission_covariance=jnp.asarray(R),
        )
        fields = ["filtered_means", "filtered_covariances"]
        found = extended_kalman_filter(parameters, y, t[:, None], output_fields=fields)
        return found.filtered_means, found.filtered_covariances

    return call_of(one, record)


def cuthbert_ekf(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
    """Return the same call of cuthbert's filter by linearised moments, which works with roots."""
    dt = float(record.t[1] - record.t[0])
    moved, h, (Q, R) = flow(ekf, dt), output(ekf), matrices(ekf, dt)
    root_Q, root_R = np.linalg.cholesky(Q / dt + 1e-300 * np.eye(len(Q))), np.linalg.cholesky(R)

    def dynamics(state: Any, model_inputs: Any) -> Any:
        t, ahead, _ = model_inputs
        return lambda x: (moved(x, t, ahead), jnp.sqrt(ahead) * root_Q), state.mean

    def outputs(state: Any, model_inputs: Any) -> Any:
        t, ahead, y = model_inputs
        return lambda x: (h(x, t + ahead), jnp.asarray(root_R)), state.mean, y

    def one(mean: Any, cov: Any, y: Any, t: Any) -> Any:
        filter = cuthbert.gaussian.moments.build_filter(
            mean, jnp.linalg.cholesky(cov), dynamics, outputs
        )
        before = jnp.concatenate([t[:1], t[:-1]])  # the first sample follows no step
        given = (before, t - before, y)
        found = cuthbert.filter(filter, given, filter.init_prepare())
        return found.mean[1:], found.chol_cov[1:]

    return call_of(one, record)


def call_of(one: Callable[..., Any], record: Record) -> Callable[[], np.ndarray]:
    """Return a call of a filter of one episode, jitted and over the batch."""
    whole = jax.jit(jax.vmap(one, in_axes=(0, 0, 0, None)))
    arrays = [jnp.asarray(a) for a in (record.prior.mean, record.prior.cov, record.y, record.t)]

    def call() -> np.ndarray:
        means, covariances = whole(*arrays)
        covariances.block_until_ready()
        return np.asarray(means)

    return call


EKFS: dict[str, Callable[[EKF, Record], Callable[[], np.ndarray]]] = {}
"""The EKFs of the libraries that are installed, by the library's name."""
with suppress(ImportError):
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    EKFS["dynamax"] = dynamax_ekf
with suppress(ImportError):
    import cuthbert
    import cuthbert.gaussian.moments

    EKFS["cuthbert"] = cuthbert_ekf
