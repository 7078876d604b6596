"""A spring that is driven by a measured force, in closed form, and CSV files of its logs."""

import csv
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from pinnobs_gym.simulation.system import Setup, System, independent, stack

A = np.array([[0.0, 1.0], [-4.0, -0.3]])


@dataclass(frozen=True)
class DrivenSpring(System):
    """A spring of which the position is measured, driven by a force that is held."""

    damping: float = 0.3

    state_names = ("q", "v")
    output_names = ("q",)
    input_names = ("force",)
    scale = (0.5, 2.0)
    setups = {
        "benchmark": Setup(
            dt=0.1, noise_std=0.05, xhat0=(0.2, -0.1), P0=independent(0.8, 1.5), process_noise=0.0
        )
    }
    model_step = 0.01

    def f(self, t, x, u):
        return stack(x, x[..., 1], -4.0 * x[..., 0] - self.damping * x[..., 1] + u[..., 0])

    def h(self, t, x, u):
        return stack(x, x[..., 0])


def moved(x, force, dt):
    """The state (2,) after dt under a constant force, and the matrix of the motion."""
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = A, 1.0
    step = expm(whole * dt)
    return step[:2, :2] @ x + step[:2, 2] * force, step[:2, :2]


class Drive:
    """A drive of the spring: forces that are held from one sample to the next."""

    def __init__(self, samples=60, seed=0, start=(0.9, 1.2)):
        rng = np.random.default_rng(seed)
        self.t = np.cumsum(rng.uniform(0.05, 0.2, samples)) + 3.0
        self.u = rng.normal(size=samples)
        self.x = np.empty((samples, 2))
        self.x[0] = start
        for k in range(1, samples):
            self.x[k], _ = moved(self.x[k - 1], self.u[k - 1], self.t[k] - self.t[k - 1])
        self.y = self.x[:, 0] + 0.05 * rng.normal(size=samples)

    def at(self, t):
        """The state (2,) at a time within the drive."""
        k = np.searchsorted(self.t, t, side="right") - 1
        return moved(self.x[k], self.u[k], t - self.t[k])[0]

    def write_log(self, path, header=("t", "q", "force")):
        return write_csv(path, header, self.t, self.y, self.u)

    def write_reference(self, path, times, states=("q", "v")):
        x = np.array([self.at(t) for t in times])
        columns = [x[:, ("q", "v").index(name)] for name in states]
        return write_csv(path, ("t", *states), times, *columns)


def write_csv(path, header, *columns):
    """Write columns with all digits; NaN is an empty cell. Returns the path."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for row in zip(*columns, strict=True):
            writer.writerow(["" if np.isnan(value) else repr(float(value)) for value in row])
    return path
