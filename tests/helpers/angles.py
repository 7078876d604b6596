"""A compass, whose readings are angles, and records of it."""

from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack

TURN = 2 * np.pi


@dataclass(frozen=True)
class Unwrapped(System):
    """A heading that changes at a constant rate, and a sensor of it that counts turns."""

    state_names = ("heading", "rate")
    output_names = ("compass",)
    units = {"heading": "rad", "rate": "rad/s", "compass": "rad"}
    scale = (3.0, 1.0)
    setups = {
        "benchmark": Setup(
            (3.0, 0.0),
            (3.0, 0.0),
            duration=30.0,
            dt=0.1,
            noise_std=0.05,
            xhat0=(3.0, 0.0),
            P0=independent(0.5, 0.2),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], 0.0 * x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0, 1], [0, 0]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1, 0]])


@dataclass(frozen=True)
class Compass(Unwrapped):
    """The same with a sensor that reads from −π to π."""

    output_period = (TURN,)
    state_period = (TURN, None)

    def h(self, t, x, u):
        xp = array_namespace(x)
        return xp.atan2(xp.sin(x[..., :1]), xp.cos(x[..., :1]))


def north_record(system, batch=3, seed=0):
    """Records of a compass that crosses the end of its range; the last row turns twice. Returns the
    headings (batch, num_samples), and the records with and without the jumps."""
    setup = system.setups["benchmark"]
    t = setup.times
    rate = np.append(np.linspace(0.002, 0.05, batch - 1), 2 * TURN / 30)
    heading = 3.1 + rate[:, None] * t
    noise = 0.05 * np.random.default_rng(seed).standard_normal(heading.shape)
    y = (heading + noise)[..., None]
    u, prior = np.zeros((batch, len(t), 0)), Prior.of(system, setup, batch)
    wrapped = np.angle(np.exp(1j * y))
    return heading, Record(t, wrapped, u, prior), Record(t, y, u, prior)
