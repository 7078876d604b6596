"""Plants whose parameters and noise are found from logs, and logs of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.logs.reading import Log
from pinnobs_gym.simulation.model import noisy_model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, stack


@dataclass(frozen=True)
class Drift(System):
    """A point that moves at a constant rate: x' = b, of which x is measured."""

    b: float = 1.0
    state_names = ("x",)
    output_names = ("y1",)
    scale = (1.0,)
    setups = {
        "benchmark": Setup(xhat0=(0.5,), P0=independent(2.0), dt=0.1, noise_std=0.2),
    }

    def f(self, t, x, u):
        return stack(x, self.b + 0.0 * x[..., 0])

    def h(self, t, x, u):
        return x


@dataclass(frozen=True)
class Oscillator(System):
    """A damped oscillator whose force u is measured, with process noise on its rate."""

    k: float = 4.0
    c: float = 0.3
    state_names = ("x", "v")
    output_names = ("y1",)
    input_names = ("u1",)
    scale = (1.0, 2.0)
    setups = {
        "benchmark": Setup(
            xhat0=(0.5, 0.0),
            P0=independent(1.0, 1.0),
            dt=0.05,
            noise_std=0.1,
            process_noise=(0.0, 0.5),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], u[..., 0] - self.k * x[..., 0] - self.c * x[..., 1])

    def h(self, t, x, u):
        return x[..., :1]


@dataclass(frozen=True)
class Swing(System):
    """A pendulum whose angle is measured, in turns that are not counted. The parameter ``spare``
    acts on nothing, and ``a`` and ``b`` only by their product; ``colour`` is no number."""

    a: float = 4.0
    b: float = 2.0
    damping: float = 0.1
    spare: float = 1.0
    colour: str = "red"
    state_names = ("angle", "rate")
    output_names = ("y1",)
    output_period = (2 * np.pi,)
    state_period = (2 * np.pi, None)
    scale = (1.0, 3.0)
    setups = {
        "benchmark": Setup(xhat0=(1.0, 0.0), P0=independent(0.3, 0.3), dt=0.05, noise_std=0.02)
    }

    def f(self, t, x, u):
        pull = self.a * self.b * array_namespace(x).sin(x[..., 0])
        return stack(x, x[..., 1] + 0.0 * self.spare, -pull - self.damping * x[..., 1])

    def h(self, t, x, u):
        return x[..., :1]


@dataclass(frozen=True)
class Decay(System):
    """x' = -kx + u, with a held input, of which x is measured almost exactly."""

    k: float = 1.0
    state_names = ("x",)
    output_names = ("y1",)
    input_names = ("u1",)
    scale = (1.0,)
    setups = {"benchmark": Setup(xhat0=(2.1,), P0=independent(1.0), dt=0.2, noise_std=0.01)}

    def f(self, t, x, u):
        return stack(x, u[..., 0] - self.k * x[..., 0])

    def h(self, t, x, u):
        return x


@dataclass(frozen=True)
class StiffDecay(Decay):
    """The same by a linearly implicit method."""

    stiff = True


@dataclass(frozen=True)
class OwnDecay(Decay):
    """The same by a flow of its own."""

    def flow(self, t0, t1, x, u):
        xp, rest = array_namespace(x), u[..., 0] / self.k
        return stack(x, rest + (x[..., 0] - rest) * xp.exp(-self.k * (t1 - t0)))


@dataclass(frozen=True)
class MapDecay(Decay):
    """The map x⁺ = kx + u."""

    discrete = True
    setups = {"benchmark": Setup(xhat0=(2.1,), P0=independent(1.0), dt=1.0, noise_std=0.01)}

    def f(self, t, x, u):
        return stack(x, self.k * x[..., 0] + u[..., 0])


def simulated_log(system, setup, num_samples, seed=0, measured_input=None):
    """A log of a plant from a setup's prior, with its process noise and output noise; and its true
    states (num_samples, nx). The input (num_samples, nu) is held."""
    rng, noise = np.random.default_rng(seed), system.noise(setup.noise_std, setup.process_noise)
    t, prior = setup.dt * np.arange(num_samples), Prior.of(system, setup, 1)
    u = np.zeros((num_samples, 0)) if measured_input is None else measured_input
    x = np.empty((num_samples, 1, 1, system.nx))
    x[0] = prior.mean + rng.standard_normal(system.nx) @ np.linalg.cholesky(prior.cov[0]).T
    for k in range(1, num_samples):
        x[k] = noisy_model_step(
            system, noise, t[k - 1], t[k], x[k - 1], u[None, k - 1], u[None, k],
            lambda m: rng.standard_normal((1, 1, m)),
        )  # fmt: skip
    y = system.h(t[:, None], x[:, 0], u[:, None])
    y = y + noise.outputs(t, rng.standard_normal((num_samples, 1, system.ny)))
    return log_of(system, setup, t, y[:, 0], u), x[:, 0, 0]


def log_of(system, setup, t, y, u=None, noise_std=None):
    """A log with outputs (num_samples, ny)."""
    u = np.zeros((len(t), 0)) if u is None else u
    std = None if noise_std is None else noise_std[None]
    record = Record(t, y[None], u[None], Prior.of(system, setup, 1), std)
    return Log(Path("log.csv"), system, record, np.arange(len(t)) + 2)
