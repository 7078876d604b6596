"""The output noise that filters assume is the one that they are told."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
from linear import Linear, linear_record

from pinnobs_gym.estimation.noise import assumed_noise
from pinnobs_gym.estimation.notices import say_once
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, stack
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

RATE, DT = 1.1e-3, 10.0


@dataclass(frozen=True)
class Orbit(System):
    """An oscillation of 7,000 km, measured to 10 m."""

    state_names = ("place", "speed")
    output_names = ("y",)
    scale = (7e6, 7.5e3)
    setups = {
        "benchmark": Setup(
            (6.9e6, -1.0),
            (7.1e6, 1.0),
            duration=6000.0,
            dt=DT,
            noise_std=10.0,
            xhat0=(7e6, 0.0),
            P0=independent(1e3, 1.0),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -RATE * RATE * x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]


def test_a_small_noise_is_taken_as_told():
    """The right filter, in closed form of the oscillation, knows the place to 0.56 m."""
    system, t = Orbit(), np.arange(600) * DT
    c, s = np.cos(RATE * DT), np.sin(RATE * DT)
    F = np.array([[c, s / RATE], [-RATE * s, c]])
    x = 7e6 * np.cos(RATE * t) + 800.0 * np.cos(RATE * t) + 0.7 / RATE * np.sin(RATE * t)
    y = x + 10.0 * np.random.default_rng(3).standard_normal(len(t))
    m, P, means = np.array([7e6, 0.0]), np.diag([1e6, 1.0]), []
    for k in range(len(t)):
        if k:
            m, P = F @ m, F @ P @ F.T
        K = P[:, 0] / (P[0, 0] + 100.0)
        m, P = m + K * (y[k] - m[0]), P - np.outer(K, P[0])
        means.append(m[0])
    record = Record(
        t,
        y[None, :, None],
        np.zeros((1, len(t), 0)),
        Prior.of(system, system.setups["benchmark"], 1),
    )
    found = EKF(system, noise_std=10.0, process_noise=0.0).run(record)
    # The Runge-Kutta steps of 10 s leave the closed form by less than a tenth of a metre.
    np.testing.assert_allclose(found.xhat[0, :, 0], means, rtol=0, atol=0.1)
    assert np.sqrt(found.P[0, -1, 0, 0]) == pytest.approx(np.sqrt(P[0, 0]), rel=1e-3)


def test_the_floor_is_taken_for_zero_alone_and_said_once(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.estimation.notices")
    assert assumed_noise(ReverseDuffing(), 1e-9) == pytest.approx([1e-9])
    assert assumed_noise(Linear(), (1e-9, 0.3)) == pytest.approx([1e-9, 0.3])
    assert caplog.records == []
    for _ in range(2):  # y2 = 2·x2, and x2 has the scale 1
        assert assumed_noise(Linear(), (0.1, 0.0)) == pytest.approx([0.1, 2e-3])
    line = "Linear: the output noise is zero; filters assume the standard deviations y2: 0.002"
    assert [record.getMessage() for record in caplog.records] == [line]
    say_once.cache_clear()


def test_the_benchmarks_are_told_their_noise_and_the_paper_a_thousandth_of_the_scale():
    for cls in SYSTEMS.classes().values():
        system, benchmark = cls.configured("benchmark")
        told = np.broadcast_to(benchmark.noise_std, (system.ny,))
        np.testing.assert_array_equal(assumed_noise(system, benchmark.noise_std), told)
        assert (assumed_noise(system, 0.0) < 0.25 * told).all()


def test_a_tiny_noise_is_followed_to_the_last_digit():
    record = linear_record()
    exact = EKF(Linear(), noise_std=1e-12, process_noise=0.0).run(record)
    # With both states measured without noise, the estimate is the measurement.
    measured = record.y / np.array([1.0, 2.0])
    np.testing.assert_allclose(exact.xhat[:, 0], measured[:, 0], atol=1e-12)
    assert (np.einsum("bkii->bki", exact.P) >= 0).all()
    assert np.isfinite(exact.xhat).all()
