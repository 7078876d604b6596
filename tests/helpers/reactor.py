"""The reversible reaction 2A ⇌ B of two gases, whose total pressure is measured (Haseltine &
Rawlings 2005, "Critical evaluation of extended Kalman filtering and moving-horizon estimation")."""

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.simulation.model import noisy_model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack

DT, SAMPLES, NOISE = 0.1, 101, 0.1


@dataclass(frozen=True)
class Reactor(System):
    """From 3 and 1; the prior is about 0.1 and 4.5. Pressures are not negative."""

    state_names = ("pA", "pB")
    output_names = ("p",)
    scale = (1.0, 1.0)
    state_low = (0.0, 0.0)
    setups = {
        "benchmark": Setup(
            (3.0, 1.0),
            (3.0, 1.0),
            duration=10.0,
            dt=DT,
            noise_std=NOISE,
            process_noise=1e-3 / np.sqrt(DT),
            xhat0=(0.1, 4.5),
            P0=independent(6.0, 6.0),
        )
    }

    def f(self, t, x, u):
        rate = 0.16 * x[..., 0] ** 2 - 0.0064 * x[..., 1]
        return stack(x, -2 * rate, rate)

    def h(self, t, x, u):
        return (x[..., 0] + x[..., 1])[..., None]

    def f_jacobian(self, t, x, u):
        by_a, by_b = 0.32 * x[..., 0], -0.0064
        return matrix(x, [[-2 * by_a, -2 * by_b], [by_a, by_b]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1.0, 1.0]])


@dataclass(frozen=True)
class QuietReactor(Reactor):
    """The same without process noise."""

    setups = {"benchmark": replace(Reactor.setups["benchmark"], process_noise=0.0)}


def reactor_record(system, batch, seed=0):
    """True states (batch, num_samples, 2), and a record of them."""
    rng, t, noise = np.random.default_rng(seed), np.arange(SAMPLES) * DT, system.noise()
    x = np.empty((SAMPLES, batch, 2))
    x[0] = (3.0, 1.0)
    for k in range(1, SAMPLES):
        x[k] = noisy_model_step(
            system,
            noise,
            t[k - 1],
            t[k],
            x[k - 1][None],
            None,
            None,
            lambda m: rng.standard_normal((1, batch, m)),
        )[0]
    y = x.sum(axis=-1, keepdims=True) + NOISE * rng.standard_normal((SAMPLES, batch, 1))
    prior = Prior.of(system, system.setups["benchmark"], batch)
    return x.swapaxes(0, 1), Record(t, y.swapaxes(0, 1), np.zeros((batch, SAMPLES, 0)), prior)
