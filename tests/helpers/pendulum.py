"""A pendulum with process noise, and records of it."""

from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, stack

DT = 0.0125


@dataclass(frozen=True)
class NoisyPendulum(System):
    """Särkkä's pendulum ("Bayesian Filtering and Smoothing", 2013, example 3.7): sin of the angle
    is measured, and the process noise acts on the rate with the spectral density 1."""

    state_names = ("angle", "rate")
    output_names = ("y1",)
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            (1.5, 0.0),
            (1.5, 0.0),
            duration=2.0,
            dt=DT,
            noise_std=0.3,
            process_noise=(0.0, 1.0),
            xhat0=(1.5, 0.0),
            P0=independent(0.1, 0.1),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -9.8 * array_namespace(x).sin(x[..., 0]))

    def h(self, t, x, u):
        return array_namespace(x).sin(x[..., :1])


def pendulum_record(batch):
    """Trajectories with the process noise of the book, whose Q leaves gravity within a step out,
    and their records."""
    system, rng = NoisyPendulum(), np.random.default_rng(0)
    t = system.setups["benchmark"].times
    Q = np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    x = np.empty((len(t), batch, 2))
    prior = Prior.of(system, system.setups["benchmark"], batch)
    x[0] = prior.mean + 0.1 * rng.standard_normal((batch, 2))
    for k in range(1, len(t)):
        noise = rng.multivariate_normal(np.zeros(2), Q, batch)
        x[k] = model_step(system, t[k - 1], t[k], x[k - 1]) + noise
    u = np.zeros((batch, len(t), 0))
    y = system.h(t[:, None], x, u.swapaxes(0, 1)) + 0.3 * rng.standard_normal((len(t), batch, 1))
    return x.swapaxes(0, 1), Record(t, y.swapaxes(0, 1), u, prior)
