"""Envs, truth and EKF."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import gymnasium as gym
import numpy as np
from scipy.integrate import solve_ivp

from benchmarks import Figure, at_least, at_most, cpu_seconds, median_ratio
from pinnobs_gym import evaluate
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

EKF_TABLE = {
    "ReverseDuffing": (0.0013, 0.0),
    "HarmonicOscillator": (0.0016, 0.0),
    "Academic": (0.0020, 0.0),
    "ModifiedAcademic": (0.0006, 0.0),
    "Satellite": (0.0022, 0.03),
    "InductionMotor": (0.0007, 0.0),
}
"""Tail NRMSE (median of 100 episodes, modulo indistinguishable states) and rate of divergence of an
independent EKF on the benchmark setup, to two digits."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the envs, the truth and the EKF."""
    yield single_env(repeats)
    for name in ("ReverseDuffing", *(n for n in SYSTEMS.classes() if n != "ReverseDuffing")):
        yield vector_env(name, repeats)
    yield from ekf_against_filterpy(repeats)
    for name in SYSTEMS.classes():
        yield truth_error(name)
    for name, (tail, diverged) in EKF_TABLE.items():
        yield from ekf_scores(name, tail, diverged)


def single_env(repeats: int) -> Figure:
    """Measure the steps of one env with random actions drawn beforehand, resets included."""
    steps = 20_000

    def player(name: str) -> Callable[[], None]:
        env = gym.make(name)
        env.action_space.seed(0)
        env.reset(seed=0)
        actions = [env.action_space.sample() for _ in range(1000)]

        def play() -> None:
            for k in range(steps):
                _, _, terminated, truncated, _ = env.step(actions[k % 1000])
                if terminated or truncated:
                    env.reset()

        return play

    peer, own = player("CartPole-v1"), player(env_id(ReverseDuffing))
    ratio = median_ratio(peer, own, repeats)
    return at_least("single env / CartPole-v1, steps per CPU-second", ratio, "x", 1.0)


def vector_env(name: str, repeats: int) -> Figure:
    """Measure the steps of 1,024 rows with random actions drawn beforehand, resets included."""
    rows = 1024

    def player(name: str, steps: int) -> Callable[[], None]:
        env = gym.make_vec(name, rows, vectorization_mode="vector_entry_point")
        env.action_space.seed(0)
        env.reset(seed=0)
        actions = [env.action_space.sample() for _ in range(100)]

        def play() -> None:
            for k in range(steps):
                env.step(actions[k % 100])

        return play

    episode = SYSTEMS.resolve(name).setups["benchmark"].num_steps + 1
    peer, own = player("CartPole-v1", episode), player(f"pinnobs/{name}-v0", episode)
    ratio = median_ratio(peer, own, repeats)
    asked = 1.0 if name == "ReverseDuffing" else None
    return at_least(f"vector env at 1,024 / CartPole-v1's, {name}", ratio, "x", asked)


def ekf_against_filterpy(repeats: int) -> Iterator[Figure]:
    """Compare the EKF on 256 episodes with filterpy's on one, with the same model and tuning.

    Estimates are compared without process noise, since filterpy's filter takes its covariance over
    a step as given; times are those with the default tuning.

    The peer's model is given in three ways: by the same System's f and Jacobian, to which the bound
    applies; written separately in NumPy; and unrolled in plain floats, the fastest for one episode.
    """
    source = EpisodeSource("ReverseDuffing")
    streams = source.streams(range(256))
    record = source.record(source.play(source.draw(streams)))
    ekf = EKF.for_setup(source.system, source.setup)
    one = record.rows(slice(0, 1))
    exact = replace(ekf, assumed_noise=0.0)
    own = exact.run(one).xhat[0]
    for name, step, asked in (
        ("the same System", system_step, 100.0),
        ("NumPy", numpy_step, None),
        ("floats", float_step, None),
    ):
        largest = float(abs(filterpy_ekf(exact, one, step) - own).max())
        what = f"filterpy's EKF (model: {name})"
        yield at_most(f"EKF - {what}, largest difference over an episode", largest, "", 1e-9)
        times = []
        for _ in range(repeats):
            peer = cpu_seconds(lambda step=step: filterpy_ekf(ekf, one, step))
            times.append((peer, cpu_seconds(lambda: ekf.run(record)) / record.batch))
        nanoseconds = np.median(times, axis=0) / record.num_samples * 1e9
        yield Figure(f"{what}, per step", float(nanoseconds[0]), "ns", "", None)
        mine = float(nanoseconds[1])
        yield Figure("EKF of 256 episodes, per step and episode", mine, "ns", "", None)
        ratio = float(np.median([peer / mine for peer, mine in times]))
        yield at_least(f"{what} / EKF of 256 episodes, per step and episode", ratio, "x", asked)


Step = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]


def filterpy_ekf(ekf: EKF, record: Record, step: Step) -> np.ndarray:
    """Return the estimates (num_samples, nx) of one ReverseDuffing episode by filterpy's EKF."""
    from filterpy.kalman import ExtendedKalmanFilter

    dt = float(record.t[1] - record.t[0])

    class Filter(ExtendedKalmanFilter):
        def predict_x(self, u=0):
            self.x, self.F = step(self.x, dt)

    filter = Filter(dim_x=2, dim_z=1)
    filter.x = record.prior.mean[0].copy()
    filter.P = record.prior.cov[0].copy()
    L = ekf.noise.L(0.0)[..., 0]
    filter.Q, filter.R = dt * L @ L.T, ekf.noise.R(0.0)[..., 0]
    H = np.array([[1.0, 0.0]])
    xhat = np.empty((record.num_samples, 2))
    for k in range(record.num_samples):
        if k:
            filter.predict()
        filter.update(record.y[0, k], lambda x: H, lambda x: x[:1])
        xhat[k] = filter.x
    return xhat


def runge_kutta(
    f: Callable[[np.ndarray], np.ndarray], A: Callable[[np.ndarray], np.ndarray]
) -> Step:
    """Return the classical Runge-Kutta step of ẋ = f(x) and of its flow Φ' = A(x)Φ."""

    def step(x: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        F = np.eye(len(x))
        k1, K1 = f(x), A(x) @ F
        x2 = x + dt / 2 * k1
        k2, K2 = f(x2), A(x2) @ (F + dt / 2 * K1)
        x3 = x + dt / 2 * k2
        k3, K3 = f(x3), A(x3) @ (F + dt / 2 * K2)
        x4 = x + dt * k3
        k4, K4 = f(x4), A(x4) @ (F + dt * K3)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), F + dt / 6 * (K1 + 2 * K2 + 2 * K3 + K4)

    return step


_system, _t, _u = ReverseDuffing(), np.asarray(0.0), np.zeros(0)
system_step = runge_kutta(
    lambda x: _system.f(_t, x, _u),
    lambda x: _system.f_jacobian(_t, x, _u),
)
numpy_step = runge_kutta(
    lambda x: np.array([x[1] ** 3, -x[0]]),
    lambda x: np.array([[0.0, 3 * x[1] ** 2], [-1.0, 0.0]]),
)


def float_step(x: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Make the step of ReverseDuffing, unrolled in plain floats."""
    a0, b0 = float(x[0]), float(x[1])
    a, b, c = a0, b0, ((1.0, 0.0), (0.0, 1.0))
    rates = []
    for weight in (0.5, 0.5, 1.0, 0.0):
        slope = 3 * b * b
        rate = (b**3, -a, slope * c[1][0], slope * c[1][1], -c[0][0], -c[0][1])
        rates.append(rate)
        h = weight * dt
        a, b = a0 + h * rate[0], b0 + h * rate[1]
        c = ((1 + h * rate[2], h * rate[3]), (h * rate[4], 1 + h * rate[5]))
    k1, k2, k3, k4 = rates
    total = [dt / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]) for i in range(6)]
    F = np.array([[1 + total[2], total[3]], [total[4], 1 + total[5]]])
    return np.array([a0 + total[0], b0 + total[1]]), F


def truth_error(name: str) -> Figure:
    """Compare the truth of 20 benchmark episodes with an independent solver at rtol 1e-12."""
    source = EpisodeSource(name)
    streams = source.streams(range(20))
    x0 = source.draw(streams).x0
    system, scale = source.system, np.asarray(source.system.scale)
    x = truth(system, x0, source.times, source.setup.truth_step)

    def f(t: float, x: np.ndarray) -> np.ndarray:
        now = np.asarray(t)
        return system.f(now, x, system.input(now))

    span, times = (0.0, float(source.times[-1])), source.times
    worst = 0.0
    for i, start in enumerate(x0):
        y = solve_ivp(f, span, start, "DOP853", times, rtol=1e-12, atol=1e-14 * scale.min()).y
        worst = max(worst, float((abs(y.T - x[:, i]) / scale).max()))
    return at_most(f"truth - reference at rtol 1e-12 over scale, {name}", worst, "", 1e-8)


def ekf_scores(name: str, tail: float, diverged: float) -> Iterator[Figure]:
    """Score the EKF on 100 benchmark episodes, with the prior of the table's figures."""
    rows = evaluate("ekf", f"pinnobs/{name}-v0", episodes=100, condition="poor_prior")
    median = float(np.median([row["nrmse_tail_modulo"] for row in rows]))
    yield at_most(f"EKF's tail NRMSE, median of 100, {name}", median, "", round(1.3 * tail, 6))
    rate = float(np.mean([not row["nrmse_tail_modulo"] <= 0.2 for row in rows]))
    yield at_most(f"EKF's rate of divergence, {name}", rate, "", diverged)
