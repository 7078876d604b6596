"""Plants whose logs are judged, beside those of the package and of `benchmarks.plants`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from log_figures.recorded import Car
from pinnobs_gym.simulation.system import Array, Setup, System, independent, stack


def steps(rng: np.random.Generator, times: np.ndarray, length: float, size: float) -> np.ndarray:
    """Return normal steps (num_samples,) of a mean length in s and a standard deviation."""
    ends = np.cumsum(rng.exponential(length, 10 + int(4 * times[-1] / length)))
    return rng.normal(0.0, size, len(ends))[np.searchsorted(ends, times)]


@dataclass(frozen=True)
class Cart(System):
    """A cart that a measured force moves against friction, disturbed by process noise: linear.
    Its position and its speed are measured."""

    friction: float = 0.3
    """Friction over mass (1/s)."""

    state_names = ("p", "v")
    output_names = ("position", "speed")
    input_names = ("force",)
    scale = (3.0, 1.0)
    setups: ClassVar = {
        "benchmark": Setup(
            xhat0=(0.0, 0.0),
            P0=independent(1.0, 0.5),
            duration=60.0,
            dt=0.1,
            noise_std=(0.05, 0.1),
            process_noise=(0.0, 0.2),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        return stack(x, x[..., 1], u[..., 0] - self.friction * x[..., 1])

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x + 0.0

    def draw_input(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        return steps(rng, times, 2.0, 0.7)[:, None]


@dataclass(frozen=True)
class Tank(System):
    """Two tanks in a row with a measured inflow (Johansson 2000); both levels are measured."""

    drain: float = 0.2
    """Rate of outflow over the root of the level (m^½/s)."""

    state_names = ("h1", "h2")
    output_names = ("level1", "level2")
    input_names = ("inflow",)
    state_low = (0.0, 0.0)
    scale = (1.0, 1.0)
    setups: ClassVar = {
        "benchmark": Setup(
            (0.8, 0.8), (1.2, 1.2), duration=400.0, dt=1.0, noise_std=0.02, process_noise=0.005
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        # Torricelli's root, smooth at an empty tank.
        out = self.drain * x / (x * x + 1e-4) ** 0.25
        return stack(x, u[..., 0] - out[..., 0], out[..., 0] - out[..., 1])

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x + 0.0

    def draw_input(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        return np.clip(0.2 + steps(rng, times, 20.0, 0.04), 0.08, 0.32)[:, None]


class DrivenCar(Car):
    """The car of `log_figures.recorded.Car` on a drive that is drawn, with a fix in each row."""

    setups: ClassVar = {
        "benchmark": Setup(
            xhat0=(0.0, 0.0, 0.5, 10.0, 0.0, 0.0),
            P0=independent(2.0, 2.0, 0.2, 1.0, 0.01, 0.1),
            duration=200.0,
            dt=0.5,
            noise_std=(1.0, 1.0, 0.2),
            process_noise=(0.1, 0.1, 0.01, 0.2, 1e-4, 1e-3),
        )
    }

    def draw_input(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        turn = np.clip(steps(rng, times, 6.0, 0.15), -0.4, 0.4)
        # Pushes that brake after they have driven, so that the speed stays near its start.
        push = np.gradient(3.0 * np.sin(0.2 * times + rng.uniform(0, 6)), times)
        return np.stack([turn, push], axis=-1)


class Swing(System):
    """A linear oscillator in place of the pendulum of `log_figures.recorded.Pendulum`."""

    state_names = ("theta", "omega")
    output_names = ("theta",)
    scale = (1.0, 8.0)
    setups: ClassVar = {
        "benchmark": Setup((-1.6, -6.0), (1.6, 6.0), duration=9.0, dt=0.01, noise_std=0.003)
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        return stack(x, x[..., 1], -64.22 * x[..., 0] - 0.0672 * x[..., 1])

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]
