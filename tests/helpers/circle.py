"""Plants of one angle, and the exact filter of them on a grid."""

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix

TURN = 2 * np.pi
RATE, DIFFUSION, DT, NOISE = 0.3, 0.05, 0.2, 0.1


@dataclass(frozen=True)
class Direction(System):
    """A direction that turns at a known rate, and is measured itself."""

    state_names = ("angle",)
    output_names = ("y",)
    scale = (1.0,)
    state_period = (TURN,)
    output_period = (TURN,)
    setups = {
        "benchmark": Setup(
            x0_low=(0.0,),
            x0_high=(0.0,),
            duration=8.0,
            dt=DT,
            noise_std=NOISE,
            process_noise=DIFFUSION,
            xhat0=(0.0,),
            P0=independent(1.0),
        )
    }

    def f(self, t, x, u):
        return 0 * x + RATE

    def h(self, t, x, u):
        return x + 0.0

    def f_jacobian(self, t, x, u):
        return matrix(x, ((0,),))

    def h_jacobian(self, t, x, u):
        return matrix(x, ((1,),))


class Turns(Direction):
    """The same angle, whose turns count, and of which the output does not tell them."""

    state_period = None


class Pair(Direction):
    """The direction, of which the cosine and the sine are measured."""

    output_names = ("c", "s")
    output_period = None

    def h(self, t, x, u):
        return np.concatenate([np.cos(x), np.sin(x)], axis=-1)

    def h_jacobian(self, t, x, u):
        return np.stack([-np.sin(x), np.cos(x)], axis=-2)


def circle_record(system, std, runs=200, samples=12, seed=0):
    """Return true angles (runs, samples, 1) and their record; the prior is that of the angles."""
    rng, t = np.random.default_rng(seed), DT * np.arange(samples)
    steps = RATE * DT + DIFFUSION * np.sqrt(DT) * rng.standard_normal((runs, samples, 1))
    steps[:, 0] = std * rng.standard_normal((runs, 1))
    x, u = np.cumsum(steps, axis=1), np.zeros((runs, samples, 0))
    y = system.h(0.0, x, u)
    y = y + NOISE * rng.standard_normal(y.shape)
    return x, Record(t, y, u, Prior(np.zeros((runs, 1)), np.full((runs, 1, 1), std**2)))


def on_grid(system, std, record, number=720):
    """Return the mean (runs, samples) of the exact filter on a circle, and its variance about it,
    for a system whose state repeats."""
    x = TURN / number * np.arange(number) - np.pi
    density = sum(np.exp(-((x + TURN * k) ** 2) / (2 * std**2)) for k in range(-9, 10))
    p = np.tile(density, (record.batch, 1))
    n = np.arange(number // 2 + 1)  # the step on the Fourier series of the density
    step = np.exp(-1j * n * RATE * DT - n**2 * DIFFUSION**2 * DT / 2)
    means, variances = [], []
    outputs = system.h(0.0, x[:, None], np.zeros((number, 0)))
    for k in range(record.num_samples):
        if k:
            p = np.maximum(np.fft.irfft(np.fft.rfft(p, axis=1) * step, number, axis=1), 0)
        e = system.output_residual(record.y[:, k, None], outputs)
        p = p * np.exp(-np.square(e).sum(axis=-1) / (2 * NOISE**2))
        p /= p.sum(axis=1, keepdims=True)
        mean = np.angle(p @ np.exp(1j * x))
        off = np.angle(np.exp(1j * (x - mean[:, None])))
        means.append(mean + (p * off).sum(axis=1))
        variances.append((p * off**2).sum(axis=1) - (p * off).sum(axis=1) ** 2)
    return np.stack(means, axis=1), np.stack(variances, axis=1)
