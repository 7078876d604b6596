"""Observers with constant gains: the unit of an output and the samples that it misses."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from pinnobs_gym.estimation.observer_gains import default_rate, settling_gain
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, stack

T = np.arange(200) * 0.1
X = np.stack([np.cos(T), -np.sin(T)], axis=-1)
NOISE = 0.01 * np.random.default_rng(1).standard_normal((len(T), 1))


def oscillator(unit):
    """A harmonic oscillator whose place is measured in a unit of 1/c."""

    @dataclass(frozen=True)
    class Oscillator(System):
        c: ClassVar[float] = unit
        state_names = ("place", "speed")
        output_names = ("y",)
        scale = (1.0, 1.0)
        setups = {
            "benchmark": Setup(
                (-1.0, -1.0),
                (1.0, 1.0),
                duration=20.0,
                dt=0.1,
                noise_std=0.01 * unit,
                xhat0=(0.0, 0.0),
                P0=independent(1.0, 1.0),
            )
        }

        def f(self, t, x, u):
            return stack(x, x[..., 1], -x[..., 0])

        def h(self, t, x, u):
            return self.c * x[..., :1]

        def f_jacobian(self, t, x, u):
            return np.array([[0.0, 1.0], [-1.0, 0.0]]) + 0 * x[..., None]

        def h_jacobian(self, t, x, u):
            return np.array([[self.c, 0.0]]) + 0 * x[..., None, :]

    return Oscillator


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e3, 1e9])
def test_a_gain_does_not_depend_on_the_unit_of_the_output(unit):
    cls = oscillator(unit)
    L = unit * settling_gain(cls(), default_rate(cls()))
    reference = oscillator(1.0)
    np.testing.assert_allclose(L, settling_gain(reference(), default_rate(reference())), rtol=1e-9)
    placed = Luenberger(cls(), poles=(-2.0, -3.0)).designed()
    np.testing.assert_allclose(unit * placed, [[5.0], [5.0]], rtol=1e-9)  # s² + l1·s + (1 + l2)


@pytest.mark.parametrize("name", ["luenberger", "sliding_mode", "ekf"])
@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_estimates_do_not_depend_on_the_unit_of_the_output(name, unit):
    def estimates(c):
        cls = oscillator(c)
        setup = cls.setups["benchmark"]
        y = c * (X[:, :1] + NOISE)
        record = Record(T, y[None], np.zeros((1, len(T), 0)), Prior.of(cls(), setup, 1))
        return ESTIMATORS.resolve(name).for_setup(cls(), setup).run(record).xhat[0]

    found = estimates(unit)
    np.testing.assert_allclose(found, estimates(1.0), atol=1e-9)
    assert abs(found - X)[150:].max() < 0.1


@dataclass(frozen=True)
class Still(System):
    """Two states at rest, each measured."""

    state_names = ("a", "b")
    output_names = ("ya", "yb")
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((-1.0, -1.0), (1.0, 1.0), duration=10.0, dt=1.0, noise_std=0.1)}

    def f(self, t, x, u):
        return 0.0 * x

    def h(self, t, x, u):
        return 1.0 * x


def test_a_missing_output_counts_the_time_from_its_own_last_sample():
    """Euler's implicit method over a time τ leaves the share 1/(1 + Lτ) of an error."""
    t = np.array([0.0, 0.5, 0.75, 1.75, 2.0])
    y = np.ones((1, 5, 2))
    y[0, 1:3, 1] = np.nan  # the second output comes at 0, 1.75 and 2 s
    record = Record(t, y, np.zeros((1, 5, 0)), Prior(np.zeros((1, 2)), np.eye(2)[None]))
    found = Luenberger(Still(), gain=[[3.0, 0.0], [0.0, 3.0]]).run(record).xhat[0]
    left = [np.cumprod([1 / (1 + 3 * tau) for tau in taus]) for taus in (np.diff(t), (1.75, 0.25))]
    np.testing.assert_allclose(found[1:, 0], 1 - left[0], rtol=1e-12)
    np.testing.assert_allclose(found[:, 1], [0, 0, 0, *(1 - left[1])], rtol=1e-12)


def test_a_first_sample_without_an_output_starts_its_clock():
    t = np.array([0.0, 0.5])
    y = np.array([[[np.nan, 1.0], [1.0, 1.0]]])
    record = Record(t, y, np.zeros((1, 2, 0)), Prior(np.zeros((1, 2)), np.eye(2)[None]))
    found = Luenberger(Still(), gain=[[3.0, 0.0], [0.0, 3.0]]).run(record).xhat[0]
    np.testing.assert_allclose(found, [[0.0, 0.0], [0.6, 0.6]], rtol=1e-12)
