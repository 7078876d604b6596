"""Plants that move otherwise than by Runge-Kutta steps between noisy samples: a map, a stiff plant,
and a reactor with held inputs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace

from benchmarks import Figure, at_most
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.simulation.truth import truth


@dataclass(frozen=True)
class Growth(System):
    """The univariate growth model, x⁺ = x/2 + 25x/(1 + x²) + 8 cos 1.2k + √10 w and y = x²/20 + v
    (Gordon, Salmond & Smith 1993, section 4)."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (10.0,)
    discrete = True
    setups = {
        "benchmark": Setup(
            x0_low=-np.sqrt(3),
            x0_high=np.sqrt(3),
            duration=100,
            dt=1,
            noise_std=1.0,
            process_noise=np.sqrt(10.0),
        )
    }

    def f(self, t, x, u):
        xp = array_namespace(x)
        return x / 2 + 25 * x / (1 + x * x) + (8 * xp.cos(1.2 * t))[..., None]

    def h(self, t, x, u):
        return x * x / 20

    def f_jacobian(self, t, x, u):
        square = x * x
        return (0.5 + 25 * (1 - square) / (1 + square) ** 2)[..., None]

    def h_jacobian(self, t, x, u):
        return (x / 10)[..., None]


@dataclass(frozen=True)
class Robertson(System):
    """Robertson's chemical kinetics, whose rates differ by nine orders (Hairer & Wanner, "Solving
    Ordinary Differential Equations II", section IV.1)."""

    state_names = ("a", "b", "c")
    output_names = ("y",)
    scale = (1.0, 4e-5, 1.0)
    stiff = True
    setups = {
        "benchmark": Setup(
            x0_low=(1, 0, 0),
            x0_high=(1, 0, 0),
            xhat0=(0.9, 1e-7, 0.05),
            P0=independent(0.1, 1e-6, 0.1),
            duration=40,
            dt=0.4,
            noise_std=1e-3,
        )
    }

    def f(self, t, x, u):
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        slow, fast, back = 0.04 * a, 3e7 * b * b, 1e4 * b * c
        return stack(x, back - slow, slow - fast - back, fast)

    def f_jacobian(self, t, x, u):
        b, c = x[..., 1], x[..., 2]
        return matrix(
            x,
            (
                (-0.04, 1e4 * c, 1e4 * b),
                (0.04, -6e7 * b - 1e4 * c, -1e4 * b),
                (0, 6e7 * b, 0),
            ),
        )

    def h(self, t, x, u):
        return x[..., 2:]

    def h_jacobian(self, t, x, u):
        return matrix(x, ((0, 0, 1),))


@dataclass(frozen=True)
class Reactor(System):
    """A continuous stirred-tank reactor whose temperatures are measured (Klatt & Engell 1998), with
    time in h: the inputs are the inflow and the heat that is removed."""

    state_names = ("c_A", "c_B", "T_R", "T_K")
    output_names = ("y1", "y2")
    input_names = ("F", "Q")
    scale = (1.0, 1.0, 10.0, 10.0)
    setups = {
        "benchmark": Setup(
            x0_low=(0.8, 0.5, 134, 130),
            x0_high=(0.8, 0.5, 134, 130),
            xhat0=(1.2, 0.7, 130, 128),
            P0=independent(0.5, 0.3, 3, 3),
            duration=5.0,
            dt=0.07,
            noise_std=0.3,
        )
    }

    def f(self, t, x, u):
        xp = array_namespace(x)
        c_A, c_B, T_R, T_K = (x[..., i] for i in range(4))
        F, Q = u[..., 0], u[..., 1]
        k1 = 1.287e12 * xp.exp(-9758.3 / (T_R + 273.15)) * c_A
        k2 = 1.287e12 * xp.exp(-9758.3 / (T_R + 273.15)) * c_B
        k3 = 9.043e9 * xp.exp(-8560 / (T_R + 273.15)) * c_A * c_A
        heat = (k1 * 4.2 - k2 * 11 - k3 * 41.85) / (-0.9342 * 3.01)
        exchanged = 4032 * 0.215 * (T_R - T_K)
        return stack(
            x,
            F * (5.1 - c_A) - k1 - k3,
            -F * c_B + k1 - k2,
            heat + F * (130 - T_R) - exchanged / (0.9342 * 3.01 * 10),
            (Q + exchanged) / 10,
        )

    def f_jacobian(self, t, x, u):
        xp = array_namespace(x)
        c_A, c_B, T = x[..., 0], x[..., 1], x[..., 2] + 273.15
        k1 = 1.287e12 * xp.exp(-9758.3 / T)
        k3 = 9.043e9 * xp.exp(-8560 / T)
        by_T1, by_T3 = k1 * 9758.3 / (T * T), k3 * 8560 / (T * T) * c_A * c_A
        F, density, exchange = u[..., 0], -0.9342 * 3.01, 4032 * 0.215
        cooled = exchange / (0.9342 * 3.01 * 10)
        return matrix(
            x,
            (
                (-F - k1 - 2 * k3 * c_A, 0, -by_T1 * c_A - by_T3, 0),
                (k1, -F - k1, by_T1 * (c_A - c_B), 0),
                (
                    (k1 * 4.2 - 2 * k3 * c_A * 41.85) / density,
                    -11 * k1 / density,
                    (by_T1 * (4.2 * c_A - 11 * c_B) - 41.85 * by_T3) / density - F - cooled,
                    cooled,
                ),
                (0, 0, exchange / 10, -exchange / 10),
            ),
        )

    def h(self, t, x, u):
        return x[..., 2:]

    def h_jacobian(self, t, x, u):
        return matrix(x, ((0, 0, 1, 0), (0, 0, 0, 1)))


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the plants of this file."""
    yield from growth()
    yield from robertson()
    yield from reactor()


def growth_runs(runs: int = 100, steps: int = 100) -> tuple[np.ndarray, Record]:
    """Return the states (runs, steps + 1, 1) and the record of runs from N(0, 1) of the growth
    model, simulated here."""
    rng = np.random.default_rng(0)
    x = [rng.standard_normal((runs, 1))]
    for k in range(steps):
        mean = x[-1] / 2 + 25 * x[-1] / (1 + x[-1] ** 2) + 8 * np.cos(1.2 * k)
        x.append(mean + np.sqrt(10) * rng.standard_normal((runs, 1)))
    path = np.stack(x, axis=1)
    y = path**2 / 20 + rng.standard_normal(path.shape)
    prior = Prior(np.zeros((runs, 1)), np.ones((runs, 1, 1)))
    return path, Record(np.arange(steps + 1.0), y, np.zeros((runs, steps + 1, 0)), prior)


def grid_means(y: np.ndarray, number: int = 801) -> np.ndarray:
    """Return the posterior means (runs, num_samples) of the growth model by a filter on a grid of
    ``number`` points from −40 to 40, given outputs (runs, num_samples)."""
    x = np.linspace(-40, 40, number)
    p = np.exp(-(x**2) / 2) * np.ones((len(y), 1))
    means = []
    for k in range(y.shape[1]):
        if k:
            mean = x / 2 + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * (k - 1))
            p = p @ np.exp(-((x - mean[:, None]) ** 2) / 20)
        p = p * np.exp(-((y[:, k, None] - x**2 / 20) ** 2) / 2)
        p /= p.sum(axis=1, keepdims=True)
        means.append(p @ x)
    return np.stack(means, axis=1)


def growth() -> Iterator[Figure]:
    """Compare the particle filter of the growth model with a filter on a grid."""
    path, record = growth_runs()
    least = _rms(grid_means(record.y[..., 0]) - path[..., 0])
    filters = (ParticleFilter(Growth(), particles=500, seed=seed) for seed in range(4))
    reached = np.mean([_rms(each.run(record).xhat - path) for each in filters])
    yield Figure("growth model: RMSE of a grid filter", least, "", "", None)
    what = "growth model: particle filter / grid filter, RMSE, mean of 4 seeds"
    yield at_most(what, float(reached / least), "", 1.02)


def robertson_times() -> np.ndarray:
    """Return the start and the sample times of Robertson's problem in s, 1e-3·2ᵏ."""
    return np.append(0.0, 1e-3 * 2.0 ** np.arange(21))


def by_radau(system: System, x0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the path (num_samples, nx) of a plant by SciPy's Radau method."""
    from scipy.integrate import solve_ivp

    scale = np.asarray(system.scale)
    solution = solve_ivp(
        lambda t, x: system.f(t, x, np.zeros(0)),
        (t[0], t[-1]),
        x0,
        "Radau",
        t,
        rtol=1e-12,
        atol=1e-15 * scale,
        jac=lambda t, x: system.f_jacobian(t, x, np.zeros(0)),
    )
    return solution.y.T


def robertson() -> Iterator[Figure]:
    """Compare Robertson's problem with SciPy's Radau method."""
    system, t = Robertson(), robertson_times()
    expected, scale = by_radau(system, np.array([1.0, 0, 0]), t), np.asarray(system.scale)
    x = np.array([[1.0, 0, 0]])
    path = truth(system, x, t)[:, 0]
    yield at_most(
        "Robertson: error of the truth", float(abs((path - expected) / scale).max()), "", 1e-6
    )
    off = 0.0
    for k in range(1, len(t)):
        x = model_step(system, t[k - 1], t[k], x)
        off = max(off, float(abs((x[0] - expected[k]) / scale).max()))
    yield at_most("Robertson: error of the model", off, "", 1e-6)


def reactor_run(seed: int) -> tuple[np.ndarray, Record]:
    """Return the states (80, 4) of the reactor by SciPy's LSODA, and the record of a run with
    inputs held over five samples."""
    from scipy.integrate import solve_ivp

    system, rng = Reactor(), np.random.default_rng(seed)
    t = np.append(0.0, np.cumsum(rng.uniform(0.02, 0.12, 79)))
    u = np.stack([rng.uniform(8, 25, 16), rng.uniform(-4000, -500, 16)], axis=-1)
    u = np.repeat(u, 5, axis=0)
    x = [np.array([0.8, 0.5, 134.0, 130.0])]
    for k in range(79):
        solution = solve_ivp(
            lambda _, x, k=k: system.f(0.0, x, u[k]),
            (t[k], t[k + 1]),
            x[-1],
            "LSODA",
            rtol=1e-11,
            atol=1e-11,
        )
        x.append(solution.y[:, -1])
    path = np.stack(x)
    y = path[:, 2:] + 0.3 * rng.standard_normal((80, 2))
    std = np.array([0.5, 0.3, 3, 3])
    mean = np.array([[1.2, 0.7, 130, 128]])
    return path, Record(t, y[None], u[None], Prior(mean, np.diag(std**2)[None]))


def reactor() -> Iterator[Figure]:
    """Compare the reactor's model and the EKF with SciPy, over 20 runs with held inputs."""
    off, error, ekf = 0.0, 0.0, EKF(Reactor(measured_input=True))
    for seed in range(20):
        path, record = reactor_run(seed)
        off = max(off, float(reactor_error(path, record)))
        error = max(error, float(abs(ekf.run(record).xhat[0, 10:, 0] - path[10:, 0]).max()))
    yield at_most("reactor: error of the model in c_A", off, "mol/l", 5e-4)
    yield at_most("reactor: error of the EKF in c_A from sample 10 on", error, "mol/l", 5e-4)


def reactor_error(path: np.ndarray, record: Record) -> float:
    """Return the largest error of the model in c_A along a run, from its true initial state."""
    system, x, off = Reactor(measured_input=True), path[:1], 0.0
    for k in range(len(path) - 1):
        u = record.u[:, k], record.u[:, k + 1]
        x = model_step(system, record.t[k], record.t[k + 1], x, *u)
        off = max(off, abs(x[0, 0] - path[k + 1, 0]))
    return off


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
