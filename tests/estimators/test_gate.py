"""The gate of the extended Kalman filter."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix

DT, NOISE, NUM = 0.1, 0.1, 60


@dataclass(frozen=True)
class Constant(System):
    """A constant that is measured, and its square."""

    state_names = ("x",)
    output_names = ("y", "square")
    scale = (1.0,)
    setups = {
        "benchmark": Setup(
            x0_low=(0.0,),
            x0_high=(0.0,),
            duration=DT * NUM,
            dt=DT,
            noise_std=NOISE,
            xhat0=(0.0,),
            P0=independent(0.1),
        )
    }

    def f(self, t, x, u):
        return 0 * x

    def h(self, t, x, u):
        return np.concatenate([x, x * x], axis=-1)

    def f_jacobian(self, t, x, u):
        return matrix(x, ((0,),))

    def h_jacobian(self, t, x, u):
        return np.stack([1 + 0 * x, 2 * x], axis=-2)


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.simulation.notices")
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


def constant_record(x, start=0.0, std=1e-3):
    """Return a record of the constant x whose prior is wrong by far, and very sure."""
    y = np.array([x, x * x]) + NOISE * np.random.default_rng(0).standard_normal((1, NUM, 2))
    prior = Prior(np.array([[start]]), np.array([[[std**2]]]))
    return Record(DT * np.arange(NUM), y, np.zeros((1, NUM, 0)), prior)


def test_a_wrong_start_is_left_after_the_patience_and_it_is_said(said):
    """The best estimate from n samples of the first output is off by noise/√n, and the second says
    more."""
    record = constant_record(2.0)
    stuck = EKF(Constant(), assumed_noise=0.0).run(record)
    found = EKF(Constant(), assumed_noise=0.0, gate=0.9999, patience=5).run(record)
    assert abs(stuck.xhat[0, -1, 0] - 2) > 1
    assert (abs(found.xhat[0, :4, 0] - 2) > 1).all()
    assert abs(found.xhat[0, -1, 0] - 2) < 3 * NOISE / np.sqrt(NUM - 5)
    (line,) = said()
    assert line.startswith("ekf on Constant: 5 samples in a row are beyond the gate")


def test_missing_samples_neither_end_nor_lengthen_a_run_beyond_the_gate():
    record = constant_record(2.0)
    gate = EKF(Constant(), assumed_noise=0.0, gate=0.9999, patience=5)
    expected = gate.run(record).xhat[0]
    y = np.full((1, 2 * NUM, 2), np.nan)
    y[:, ::2] = record.y
    u = np.zeros((1, 2 * NUM, 0))
    found = gate.run(Record(DT / 2 * np.arange(2 * NUM), y, u, record.prior)).xhat[0, ::2]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_output_that_tells_nothing_at_the_estimate_still_counts(said):
    """At x̂ = 0 the square has the slope zero; where it alone is measured, nothing can be corrected,
    but that it is wrong is seen."""
    record = constant_record(2.0)
    record.y[..., 0] = np.nan
    EKF(Constant(), assumed_noise=0.0, gate=0.9999, patience=5).run(record)
    assert len(said()) == 1


def test_a_consistent_filter_never_restarts(said):
    """Of 60 samples, fewer than one in a million runs has 15 in a row beyond."""
    record = constant_record(2.0, start=2.0, std=0.1)
    free = EKF(Constant(), assumed_noise=0.0).run(record)
    gated = EKF(Constant(), assumed_noise=0.0, gate=0.99).run(record)
    np.testing.assert_array_equal(gated.xhat, free.xhat)
    assert not said()
