"""Compiled estimators other than the Kalman filters of `test_compiled` against the same in NumPy:
observers with a constant gain or forgetting, the strong-tracking filter, and the model alone."""

from dataclasses import dataclass, replace

import many_plants
import numpy as np
import pytest
from agreement import FIELDS, assert_near, assert_same
from fake_compilers import needs_compiler
from learned_gains import gain_of
from linear import Linear, linear_record, record_of

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.compiled import compiled_filter
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators.high_gain import HighGain
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.estimators.sliding_mode import SlidingMode
from pinnobs_gym.estimators.strong_tracking_ekf import StrongTrackingEKF
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.systems import SYSTEMS

pytestmark = needs_compiler


def learned(system, level=None):
    """A learned gain of small random weights; larger ones let estimates diverge."""
    return gain_of(system, 0.1, noise_std=level)


OBSERVED = [  # the gain of the design is not stable on the augmented cart; it multiplies rounding
    *(many_plants.cart, many_plants.cart_with_joined_input, many_plants.bounded_reactor),
    *(many_plants.escape, many_plants.well),
]
FORGETTING = [  # one that escapes is brought back from 1e21 to what rounding leaves
    *(many_plants.cart, many_plants.cart_of_each_row, many_plants.cart_with_noise_by_sample),
    *(many_plants.cart_with_wide_priors, many_plants.henon, many_plants.bounded_reactor),
]
PLANTS = {
    Luenberger: OBSERVED,
    SlidingMode: [*OBSERVED, many_plants.cart_with_noise_by_sample],
    HighGain: FORGETTING,
    StrongTrackingEKF: many_plants.PLANTS,
    learned: [many_plants.cart, many_plants.henon, many_plants.well],
    OpenLoop: [many_plants.henon_with_measured_input, many_plants.cart_of_each_row],
}


def in_numpy(estimator):
    """The same estimator without compiled code."""
    other = replace(estimator)
    vars(other)["compiled"] = None
    return other


def stepped(estimator, record, goes_on=None, after=None):
    """The estimates from `Estimator.update`, of another estimator after some samples."""
    state, states = estimator.reset(record.prior), []
    with np.errstate(all="ignore"):
        for k, t in enumerate(record.t.tolist()):
            own = goes_on if after is not None and k >= after else estimator
            state = own.update(state, t, record.y[:, k], record.u[:, k])
            states.append(state)
    return stacked(states)


def stacked(states):
    fields = {name: [getattr(state, name) for state in states] for name in FIELDS}
    return Estimates(
        **{name: None if v[0] is None else np.stack(v, axis=1) for name, v in fields.items()}
    )


def rows_of(estimates, rows):
    values = {name: getattr(estimates, name) for name in FIELDS}
    return Estimates(**{name: None if v is None else v[rows] for name, v in values.items()})


@pytest.mark.parametrize("kind", PLANTS)
@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_it_agrees_with_numpy_on_each_system(kind, name):
    source = EpisodeSource(name)
    record, estimator = record_of(source, 2).first_samples(60), kind(source.system)
    assert estimator.compiled is not None, compiled_filter(estimator)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))


@pytest.mark.parametrize(("kind", "plant"), [(k, p) for k in PLANTS for p in PLANTS[k]])
def test_it_agrees_with_numpy_and_itself(kind, plant):
    """Irregular times, missing outputs, inputs, angles, bounds, maps, wide priors, rows that
    diverge; updates give what a run gives, either goes on from a state of the other, and a row is
    the same alone and in any batch."""
    system, record = plant(9)
    level = None if record.noise_std is None else SampledLevel(record.t, record.noise_std)
    estimator = kind(system, level)
    whole, other = estimator.run(record), in_numpy(estimator)
    assert_near(whole, other.run(record))
    assert_same(stepped(estimator, record), whole)
    for first, second in ((estimator, other), (other, estimator)):
        assert_near(stepped(first, record, second, 8), whole)
    rows = np.array([1, 4, 8])
    own = {name: value[rows] for name, value in system.parameters.items() if np.ndim(value)}
    part = kind(replace(system, **own), None if level is None else level.rows(rows))
    assert_same(part.run(record.rows(rows)), rows_of(whole, rows))


@pytest.mark.parametrize(
    "estimator",
    [
        StrongTrackingEKF(Linear(), gamma=1e-3, output_factor=0.7),
        HighGain(Linear(), theta=40.0, process_noise=0.1),
        SlidingMode(Linear(), layer=0.5, switching=9.0),
    ],
    ids=lambda estimator: estimator.label,
)
def test_it_agrees_with_numpy_under_other_settings(estimator):
    record = linear_record(3)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))
    assert abs(estimator.run(record).xhat - type(estimator)(Linear()).run(record).xhat).max() > 1e-3


def test_the_correction_of_two_outputs_is_that_of_the_equations():
    """Without motion and with H = I, x moves by the share wL/(1 + wL) of the innovation."""

    @dataclass(frozen=True)
    class Still(many_plants.Escape):
        def f(self, t, x, u):
            return 0.0 * x

        def h(self, t, x, u):
            return x

    gain, record = np.array([[3.0, 1.0], [-2.0, 5.0]]), many_plants.escape(2)[1].first_samples(2)
    record = replace(record, y=np.arange(8.0).reshape(2, 2, 2))
    estimator = Luenberger(Still(), gain=gain.tolist())
    assert estimator.compiled is not None
    x, w = record.prior.mean, record.t[1] - record.t[0]
    K = w * gain @ np.linalg.inv(np.eye(2) + w * gain)
    expected = x + (record.y[:, 1] - x) @ K.T
    np.testing.assert_allclose(estimator.run(record).xhat[:, 1], expected, rtol=1e-13)


@dataclass(frozen=True)
class Bolder(SlidingMode):
    """It overrides a part of the correction."""

    def secant(self, innovation, t):
        return 2.0 * super().secant(innovation, t)


def test_a_subclass_uses_its_own_methods():
    record, estimator = linear_record(), Bolder(Linear())
    assert compiled_filter(estimator) == "Bolder defines secant"
    found = estimator.run(record)
    assert abs(found.xhat - SlidingMode(Linear()).run(record).xhat).max() > 1e-4
    assert_same(found, in_numpy(estimator).run(record))


def test_a_learned_gain_with_a_noise_of_its_own_is_that_of_numpy():
    """Its training tries it at several levels at once."""
    record, estimator = linear_record(3), learned(Linear())
    R = np.eye(Linear().ny)[..., None] * np.array([0.01, 0.1, 1.0]) ** 2
    state = other = estimator.begin(record.prior, R)
    for k, t in enumerate(record.t.tolist()):
        state = estimator.update(state, t, record.y[:, k], record.u[:, k])
        other = estimator.update_by_numpy(other, t, record.y[:, k], record.u[:, k])
        assert state.packed is not None
        np.testing.assert_allclose(state.xhat, other.xhat, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(state.S, other.S, rtol=1e-9)


def test_a_recurrent_gain_and_a_wide_one_stay_in_numpy():
    assert compiled_filter(gain_of(Linear(), variant="gru")) == "its network is recurrent"
    assert compiled_filter(gain_of(Linear(), width=300)) == "its network is 300 wide, more than 256"
