"""Systems that estimate what the mismatch conditions change."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym import stack
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.augmented import with_constants
from pinnobs_gym.simulation.conditions.plant import uncertain_parameters
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.uncertain_plant import with_uncertain_plant
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.satellite import Satellite

CONSTANTS = {
    "Academic": {"rate_x1": 0.0, "rate_x2": 0.0},
    "HarmonicOscillator": {"rate_x1": 0.0, "rate_x2": 0.0, "rate_x3": 0.0},
    "InductionMotor": {"R_s": 0.18, "R_r": 0.15, "J": 0.0586, "T_L": 10.0},
    "ModifiedAcademic": {"rate_x1": 0.0, "rate_x2": 0.0},
    "ReverseDuffing": {"rate_x1": 0.0, "rate_x2": 0.0},
    "Satellite": {"a1": 0.5, "a2": -0.875, "a3": 2 / 3},
}
"""Means of the constants of each system."""


def with_episodes(name, episodes):
    """A source of mismatched episodes, these, their record, the system with an uncertain plant, and
    the record for it."""
    source = EpisodeSource(name, condition="mismatch10")
    batch = source.play(source.draw(source.streams(range(episodes))))
    record = source.record(batch)
    system = with_uncertain_plant(source.system, 0.1)
    prior = Prior.of(system, with_constants(system, source.setup), episodes)
    return source, batch, record, system, replace(record, prior=prior)


def test_all_systems_are_listed():
    assert set(CONSTANTS) == set(SYSTEMS.classes())


@pytest.mark.parametrize("name", CONSTANTS)
def test_an_ekf_of_an_uncertain_plant_runs_on_mismatched_records(name, monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")  # the compilation would take longer
    source, _, record, system, larger = with_episodes(name, 3)
    n, means = source.system.nx, np.array(list(CONSTANTS[name].values()))
    stds = np.where(means == 0, 0.1, 0.1 * abs(means))
    assert system.state_names == (*source.system.state_names, *CONSTANTS[name])
    assert np.allclose(system.scale[n:], stds, rtol=1e-14)
    # The prior is the system's own and that of the constants, block diagonal.
    expected = np.zeros((3, system.nx, system.nx))
    expected[:, :n, :n], expected[:, n:, n:] = record.prior.cov, np.diag(stds**2)
    assert np.allclose(larger.prior.cov, expected, rtol=1e-12, atol=0)
    assert np.allclose(larger.prior.mean[:, :n], record.prior.mean, rtol=1e-12)
    assert np.allclose(larger.prior.mean[:, n:], means, rtol=1e-12)
    few = {"t": record.t[:50], "y": record.y[:, :50], "u": record.u[:, :50]}
    found = EKF(system).run(replace(larger, **few))
    assert found.xhat.shape == (3, 50, system.nx)
    assert np.isfinite(found.xhat).all()


def test_steady_errors_of_a_mismatched_plant_are_smaller():
    source, batch, record, system, larger = with_episodes("ReverseDuffing", 20)
    steady = record.t >= source.setup.transient_end
    x = np.swapaxes(batch.x, 0, 1)[:, : record.num_samples]

    def error(estimator, record):
        """The median over episodes of each state's RMS error."""
        off = estimator.run(record).xhat[..., :2] - x
        return np.median(np.sqrt((off[:, steady] ** 2).mean(axis=1)), axis=0)

    plain, uncertain = error(EKF(source.system), record), error(EKF(system), larger)
    assert uncertain[0] < 0.2 * plain[0]
    assert uncertain[1] < 0.9 * plain[1]


def test_the_values_are_those_of_the_system_that_is_given():
    system = with_uncertain_plant(Satellite(a2=-2.0, measure_x3=True), 0.25)
    assert system.scale[3:] == pytest.approx((0.125, 0.5, 0.25 * 2 / 3))
    assert system.parameters == {"measure_x3": True}
    setup = with_constants(system, Satellite.setups["benchmark"])
    assert setup.xhat0[3:] == pytest.approx((0.5, -2.0, 2 / 3))
    idle = with_uncertain_plant(InductionMotor(T_L=0.0), 0.1)  # no part of 0 is a deviation
    assert idle.state_names[5:] == ("R_s", "R_r", "J")
    assert idle.parameters["T_L"] == 0


@dataclass(frozen=True)
class Moved(Linear):
    """A plant without parameters that moves by a flow of its own."""

    def flow(self, t0, t1, x, u):
        rate, dt = self.f(t0, x, u), t1 - t0
        return stack(x, x[..., 0] + dt * rate[..., 0], x[..., 1] + dt * rate[..., 1])


@dataclass(frozen=True)
class MovedByK(Moved):
    """The same with a parameter."""

    k: float = -2.0

    def f(self, t, x, u):
        return stack(x, x[..., 1], self.k * x[..., 0])


@dataclass(frozen=True)
class Named(Linear):
    """A parameter that is no number."""

    kind: str = "soft"


class Sure(Named):
    """It is named as what is uncertain."""

    uncertain = ("kind",)


def test_nothing_to_estimate_is_none():
    assert with_uncertain_plant(Moved(), 0.1) is None
    assert with_uncertain_plant(MovedByK(k=0.0), 0.1) is None
    moved = with_uncertain_plant(MovedByK(), 0.1)
    assert moved.state_names == ("x1", "x2", "k")
    assert moved.own_flow


@pytest.mark.parametrize("deviation", [0.0, -0.1, np.nan, "0.1", True])
def test_a_deviation_is_a_number_above_0(deviation):
    with pytest.raises(ValueError, match=r"deviation=.*; expected a number above 0"):
        with_uncertain_plant(Linear(), deviation)


def test_a_parameter_that_is_no_number_is_left_out_unless_it_is_named():
    rates = with_uncertain_plant(Named(), 0.1)
    assert rates.state_names == with_uncertain_plant(Linear(), 0.1).state_names
    with pytest.raises(ValueError, match="parameter kind='soft' of Sure; expected a number"):
        with_uncertain_plant(Sure(), 0.1)


def test_parameters_that_are_no_numbers_do_not_change():
    """Texts, and nested tuples of different lengths, which are no array."""

    @dataclass(frozen=True)
    class Tables(Linear):
        a: float = 1.0
        label: str = "mine"
        levels: tuple = ((1.0, 2.0), (3.0,))
        gains: tuple = (1.0, 2.0)

    assert set(uncertain_parameters(Tables())) >= {"a", "gains"}
    assert not {"label", "levels"} & set(uncertain_parameters(Tables()))
