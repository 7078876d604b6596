"""A linear system, on which filters have closed forms, and records of episodes."""

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter

from pinnobs_gym.envs.episodes import EpisodeSource, Stream
from pinnobs_gym.simulation.system import Setup, System, stack


@dataclass(frozen=True)
class Linear(System):
    """A damped oscillator of which both states are measured, the second in double."""

    state_names = ("x1", "x2")
    output_names = ("y1", "y2")
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            (-1.0, -1.0), (1.0, 1.0), (0.3, -0.2), (0.8, 0.5), duration=2.0, dt=0.1, noise_std=0.1
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


def record_of(source, batch):
    streams = [Stream(np.random.SeedSequence(seed)) for seed in range(batch)]
    return source.record(source.play(source.draw(streams)))


def linear_record(batch=3):
    return record_of(EpisodeSource(Linear), batch)


def kalman_filter(record, row, process_noise, noise_std):
    """filterpy's Kalman filter on an episode of the linear system, yielded after every sample."""
    peer = KalmanFilter(dim_x=2, dim_z=2)
    peer.x, peer.P = record.prior.mean[row].copy(), record.prior.cov[row].copy()
    peer.F, peer.H = runge_kutta_matrix(0.1), H
    peer.Q, peer.R = np.eye(2) * process_noise**2, np.diag(np.square(noise_std))
    for k in range(record.num_samples):
        if k:
            peer.predict()
        peer.update(record.y[row, k])
        yield peer
