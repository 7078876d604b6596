"""A linear system, on which filters have closed forms, and records of episodes."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from array_api_compat import array_namespace
from filterpy.kalman import KalmanFilter
from scipy.linalg import expm

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation.system import Setup, System, independent, stack


@dataclass(frozen=True)
class Linear(System):
    """A damped oscillator of which both states are measured, the second in double."""

    state_names = ("x1", "x2")
    output_names = ("y1", "y2")
    scale = (1.0, 1.0)
    model_step = 0.1  # one step per sample, as in `runge_kutta_matrix`
    setups = {
        "benchmark": Setup(
            (-1.0, -1.0),
            (1.0, 1.0),
            duration=2.0,
            dt=0.1,
            noise_std=0.1,
            xhat0=(0.3, -0.2),
            P0=independent(0.8, 0.5),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -2.0 * x[..., 0] - 0.3 * x[..., 1])

    def h(self, t, x, u):
        return stack(x, x[..., 0], 2 * x[..., 1])


A = np.array([[0.0, 1.0], [-2.0, -0.3]])
H = np.array([[1.0, 0.0], [0.0, 2.0]])


def runge_kutta_matrix(dt):
    """What the classical Runge-Kutta method does to a linear system."""
    h = dt * A
    return np.eye(2) + h + h @ h / 2 + h @ h @ h / 6 + h @ h @ h @ h / 24


def noise_matrix(level):
    """The matrix M of a noise Mw, from M or from its standard deviations."""
    return np.asarray(level) if np.ndim(level) == 2 else np.diag(np.broadcast_to(level, 2))


def process_covariance(process_noise, dt=0.1, drift=A):
    """Q = ∫exp(As)LLᵀexp(Aᵀs)ds over dt, by the matrix exponential of Van Loan ("Computing
    integrals involving the matrix exponential", 1978, theorem 1)."""
    L, size = noise_matrix(process_noise), len(drift)
    blocks = expm(dt * np.block([[-drift, L @ L.T], [np.zeros((size, size)), drift.T]]))
    return blocks[size:, size:].T @ blocks[:size, size:]


NOISE_OF_FILTERS = [
    (0.0, (0.1, 0.2), 1e-12),
    (0.15, (0.1, 0.2), 1e-6),
    (((0.1, 0.05), (0.0, 0.2)), ((0.1, 0.0), (0.15, 0.2)), 1e-6),
]
"""Process noise, output noise, and the tolerance of estimates and covariances. Simpson's rule, by
which estimators compute Q, is off by 2e-6 of Q over a sample of `Linear`."""


def record_of(source, batch):
    streams = source.streams(range(batch))
    return source.record(source.play(source.draw(streams)))


def linear_record(batch=3):
    return record_of(EpisodeSource(Linear), batch)


@dataclass(frozen=True)
class FeedThrough(Linear):
    """The same with outputs y = C(t, u)x + Du + (sin 3t, 0)/2, where C is `H` with its first row
    times 1 + m(sin t + u/2)."""

    modulation: ClassVar[float] = 0.0
    """m."""
    input_names = ("u1",)
    input_hold = "linear"

    def h(self, t, x, u):
        xp, u1 = array_namespace(x), u[..., 0]
        t = t + 0 * u1  # a number has no namespace
        gain = 1 + self.modulation * (xp.sin(t) + 0.5 * u1)
        first = gain * x[..., 0] + D[0] * u1 + 0.5 * xp.sin(3 * t)
        return stack(x, first, 2 * x[..., 1] + D[1] * u1)

    def input(self, t):
        return array_namespace(t).stack([array_namespace(t).cos(5 * t) + 0.3], axis=-1)

    # By hand, for automatic differentiation takes milliseconds a call; a test compares the two.
    def f_jacobian(self, t, x, u):
        return array_namespace(x).asarray(A) + 0.0 * x[..., None]

    def h_jacobian(self, t, x, u):
        xp, zero = array_namespace(x), 0.0 * x[..., 0]
        u1 = u[..., 0]
        gain = 1 + self.modulation * (xp.sin(t + 0 * u1) + 0.5 * u1)
        rows = [[gain + zero, zero], [zero, 2.0 + zero]]
        return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class Modulated(FeedThrough):
    """The same with an output Jacobian that changes with time and input."""

    modulation = 0.4


D = (0.7, -1.1)


def jacobians(system, t, u):
    """C(t, u) of `FeedThrough`, (num_samples, 2, 2), at times (num_samples,), inputs (..., 1)."""
    C = np.repeat(H[None], len(t), axis=0)
    C[:, 0] *= (1 + system.modulation * (np.sin(t) + 0.5 * u[:, 0]))[:, None]
    return C


def fed_through(record, measured, seed=0):
    """`FeedThrough` and a record of it, from one of `Linear`: Du + (sin 3t, 0)/2 is added to the
    outputs. The input is the system's own or, if measured, random."""
    t, system = record.t, FeedThrough(measured_input=measured)
    if measured:
        u = np.random.default_rng(seed).standard_normal((*record.y.shape[:2], 1))
    else:
        u = np.repeat(system.input(t)[None], record.batch, axis=0)
    known = D * u + 0.5 * np.stack([np.sin(3 * t), 0 * t], axis=-1)
    return system, replace(record, y=record.y + known, u=u)


def kalman_filter(record, row, process_noise, noise_std, C=None):
    """filterpy's Kalman filter on an episode of the linear system, yielded after every sample.
    Process noise is per √s, and each noise is given by standard deviations or a matrix. The output
    matrix C (num_samples, 2, 2) is `H` if None."""
    peer = KalmanFilter(dim_x=2, dim_z=2)
    peer.x, peer.P = record.prior.mean[row].copy(), record.prior.cov[row].copy()
    peer.F, peer.H = runge_kutta_matrix(0.1), H
    G = noise_matrix(noise_std)
    peer.Q, peer.R = process_covariance(process_noise), G @ G.T
    for k in range(record.num_samples):
        if k:
            peer.predict()
        if C is not None:
            peer.H = C[k]
        peer.update(record.y[row, k])
        yield peer
