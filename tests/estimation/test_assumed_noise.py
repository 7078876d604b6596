"""The process noise that filters assume, where the scale of a state is far above its noise."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.systems import SYSTEMS

RATE, NOISE, DT, NUM = 1.1e-3, 10.0, 10.0, 600


@dataclass(frozen=True)
class Height(System):
    """The height and the speed of an oscillation of 1 km about 7000 km, of which the height is
    measured to 10 m."""

    state_names = ("height", "speed")
    output_names = ("y",)
    scale = (7e6, 7.5e3)
    setups = {
        "benchmark": Setup(
            x0_low=(7e6, 0.0),
            x0_high=(7e6, 0.0),
            xhat0=(7e6, 0.0),
            P0=independent(1e3, 1.0),
            duration=DT * NUM,
            dt=DT,
            noise_std=NOISE,
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -(RATE**2) * x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, ((0, 1), (-(RATE**2), 0)))

    def h_jacobian(self, t, x, u):
        return matrix(x, ((1, 0),))


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.simulation.notices")
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


def height_record():
    """Return true heights (NUM,) and their record."""
    t = DT * np.arange(NUM)
    height = (7e6 + 800) * np.cos(RATE * t) + 0.7 / RATE * np.sin(RATE * t)
    y = height + NOISE * np.random.default_rng(3).standard_normal(NUM)
    prior = Prior(np.array([[7e6, 0.0]]), np.diag([1e6, 1.0])[None])
    return height, Record(t, y[None, :, None], np.zeros((1, NUM, 0)), prior)


@pytest.mark.parametrize("name", ["ekf", "ukf", "mhe", "rts_smoother"])
def test_it_is_said_that_estimates_follow_the_latest_output(name, said):
    height, record = height_record()
    cls = ESTIMATORS.resolve(name)
    errors = []
    for settings in ({}, {"assumed_noise": 0.0}):
        run = cls(Height(), **settings).run(record)
        errors.append(np.sqrt(np.mean((run.xhat[0, 450:, 0] - height[450:]) ** 2)))
    (line,) = said()
    assert line.startswith(f"{name} on Height: assumed_noise=")
    assert errors[0] > 0.5 * NOISE
    assert errors[1] < 0.03 * NOISE


def test_what_the_line_expects_is_not_said_again(said):
    cls = ESTIMATORS.resolve("ekf")
    _ = cls(Height()).noise
    (line,) = said()
    expected = float(line.split("expected at most ")[1].split(",")[0])
    say_once.cache_clear()
    _ = cls(Height(), assumed_noise=expected).noise
    _ = cls(Height(), process_noise=(300.0, 0.3)).noise  # known noise that is as large
    assert len(said()) == 1


def test_nothing_is_said_of_the_built_in_systems(said):
    for system in SYSTEMS.classes().values():
        for name in ("ekf", "mhe"):
            _ = ESTIMATORS.resolve(name)(
                system(), noise_std=system.setups["benchmark"].noise_std
            ).noise
    assert not [line for line in said() if "assumed_noise" in line]
