"""Compiled filters against the same in NumPy, which is the reference, and against themselves."""

import copy
import itertools
import pickle
import threading
from dataclasses import dataclass, replace
from functools import cache

import many_plants
import numpy as np
import pytest
from agreement import FIELDS, assert_near, assert_same
from fake_compilers import needs_compiler
from linear import Linear, linear_record, record_of

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.compiled import compiled_filter
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.noise import Noise, SampledLevel
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import stack
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

pytestmark = needs_compiler
KINDS = pytest.mark.parametrize("kind", [EKF, UKF, CKF])
PLANTS = pytest.mark.parametrize("plant", many_plants.PLANTS)


def in_numpy(estimator):
    """The same estimator without compiled code."""
    other = replace(estimator)
    vars(other)["compiled"] = None
    return other


played = cache(lambda plant, batch: plant(batch))  # a plant and its record, which do not change


@cache
def filters(kind, plant, batch=60, **options):
    """The filter of a plant, and a record."""
    system, record = played(plant, batch)
    level = None if record.noise_std is None else SampledLevel(record.t, record.noise_std)
    estimator = kind(system, level, **options)
    assert estimator.compiled is not None, compiled_filter(estimator)
    return estimator, record


@cache
def beginning(name):
    """The first samples of two episodes of a system."""
    record = record_of(EpisodeSource(name), 2)
    parts = {"t": record.t[:100], "y": record.y[:, :100], "u": record.u[:, :100]}
    return replace(record, **parts)


def steps(estimator, record, samples=None, state=None, first=0):
    """The states after each sample, from `Estimator.update`."""
    state = estimator.reset(record.prior) if state is None else state
    states = []
    with np.errstate(all="ignore"):
        for k in range(first, record.num_samples if samples is None else samples):
            state = estimator.update(state, float(record.t[k]), record.y[:, k], record.u[:, k])
            states.append(state)
    return states


def stacked(states):
    return Estimates(*(np.stack([getattr(s, name) for s in states], axis=1) for name in FIELDS))


@KINDS
@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_it_agrees_with_numpy_on_each_system(kind, name):
    source = EpisodeSource(name)
    record, estimator = beginning(name), kind.for_setup(source.system, source.setup)
    assert estimator.compiled is not None
    assert_near(estimator.run(record), in_numpy(estimator).run(record))


@KINDS
@PLANTS
def test_it_agrees_with_numpy(kind, plant):
    estimator, record = filters(kind, plant, 20)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (EKF, {"gate": 0.9, "patience": 2}),
        (EKF, {"huber": 1.345}),
        (EKF, {"gate": 0.9, "patience": 1, "huber": 0.5}),
        (EKF, {"assumed_noise": 0.0}),
        (UKF, {"beta": 2.0}),
        (UKF, {"assumed_noise": 0.0}),
    ],
)
@pytest.mark.parametrize("plant", [many_plants.cart, many_plants.bounded_reactor])
def test_it_agrees_with_numpy_under_other_settings(kind, options, plant):
    estimator, record = filters(kind, plant, 20, **options)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))
    assert_same(stacked(steps(estimator, record)), estimator.run(record))


@KINDS
@PLANTS
def test_a_row_is_the_same_alone_and_in_any_batch(kind, plant):
    system, record = played(plant, 60)
    whole = kind(system).run(record)
    for size in (1, 2, 3, 7, 8, 9):
        rows = np.arange(60 - size, 60) if size % 2 else np.arange(0, 60, 60 // size)[:size]
        part = record.rows(rows)
        own = {n: v[rows] for n, v in system.parameters.items() if np.ndim(v)}
        found = kind(replace(system, **own)).run(part)
        expected = Estimates(*(getattr(whole, name)[rows] for name in FIELDS))
        assert_same(found, expected)


@KINDS
@PLANTS
@pytest.mark.parametrize("batch", [1, 11])
def test_updates_give_what_a_run_gives(kind, plant, batch):
    estimator, record = filters(kind, plant, batch)
    assert_same(stacked(steps(estimator, record)), estimator.run(record))


@KINDS
def test_updates_with_noise_by_sample_give_what_a_run_gives(kind):
    system, record = many_plants.cart_with_noise_by_sample(11)
    level = SampledLevel(record.t, record.noise_std)
    estimator = kind(system, level)
    assert estimator.compiled is not None
    assert_same(stacked(steps(estimator, record)), estimator.run(record))
    assert_same(estimator.run(record), kind(system).run(record))
    # At times between those of the noise, the other level holds.
    early = replace(estimator, noise_std=replace(level, t=level.t - 1e-3 * (level.t > 0.5)))
    assert_near(early.run(record), in_numpy(early).run(record))
    assert_same(stacked(steps(early, record)), early.run(record))


@KINDS
@PLANTS
def test_either_goes_on_from_a_state_of_the_other(kind, plant):
    estimator, record = filters(kind, plant, 5)
    other, middle = in_numpy(estimator), record.num_samples // 2
    expected = stacked(steps(other, record))
    for first, second in ((estimator, other), (other, estimator)):
        before = steps(first, record, middle)
        after = steps(second, record, state=before[-1], first=middle)
        assert_near(stacked([*before, *after]), expected)


@KINDS
def test_a_state_with_a_value_replaced_is_used_with_it(kind):
    estimator, record = filters(kind, many_plants.cart_with_measured_input, 3)
    state = steps(estimator, record, 4)[-1]
    changes = [
        {"xhat": state.xhat + 0.1},
        {"P": 2 * state.P},
        {"u": state.u + 0.5},
        {"t": state.t - 0.02},
        {"t": None, "u": None},
        {},
    ]
    for change in changes:
        changed = replace(state, **change)
        found = steps(estimator, record, 5, changed, 4)
        assert_near(stacked(found), stacked(steps(in_numpy(estimator), record, 5, changed, 4)))
    state.xhat[1] += 0.1  # in place
    found = steps(estimator, record, 5, state, 4)
    assert_near(stacked(found), stacked(steps(in_numpy(estimator), record, 5, state, 4)))


@KINDS
@pytest.mark.parametrize("plant", [many_plants.cart_with_measured_input, many_plants.henon])
def test_copies_of_states_and_estimators(kind, plant):
    estimator, record = filters(kind, plant, 3)
    before, state, expected = steps(estimator, record, 6)[-3:]
    for copied in (copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))):
        own, other = copied(state), copied(estimator)
        found = steps(other, record, 6, own, 5)[-1]
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for copied in (copy.deepcopy(state), pickle.loads(pickle.dumps(state))):
        assert copied.packed is None  # an address holds in its own process and place only
    # A state is not changed by what follows from it.
    again = steps(estimator, record, 5, before, 4)[-1]
    np.testing.assert_array_equal(again.xhat, state.xhat)


@KINDS
def test_results_are_not_shared_between_calls(kind):
    estimator, record = filters(kind, many_plants.cart, 2)
    states = steps(estimator, record)
    kept = [copy.deepcopy(state) for state in states]
    steps(estimator, record)
    for state, copied in zip(states, kept, strict=True):
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(state, name), getattr(copied, name))


@KINDS
def test_threads_share_an_estimator(kind):
    gate = {"gate": 0.9, "patience": 2} if kind is EKF else {}
    estimator, record = filters(kind, many_plants.bounded_reactor, 60, **gate)
    parts = [record.rows(np.arange(i, 60, 4)) for i in range(4)]
    expected = [stacked(steps(estimator, part)) for part in parts]
    found = [None] * len(parts)

    def work(i):
        for _ in range(3):
            found[i] = stacked(steps(estimator, parts[i])), estimator.run(parts[i])

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(parts))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for pair, each in zip(found, expected, strict=True):
        assert_same(pair[0], each)
        assert_same(pair[1], each)


@dataclass(frozen=True)
class Doubled(EKF):
    """It corrects twice as much."""

    def correct(self, state, t, y, u):
        after = super().correct(state, t, y, u)
        return replace(after, xhat=2 * after.xhat - state.xhat)


@dataclass(frozen=True)
class Unweighted(EKF):
    """It overrides a part of the correction."""

    def _reweighted(self, P, innovation, H, R):
        return 100 * R


@dataclass(frozen=True)
class NoisyCKF(CKF):
    """It predicts more noise."""

    def predict(self, state, t, u):
        after = super().predict(state, t, u)
        return replace(after, P=after.P + 0.01)


@pytest.mark.parametrize(
    "estimator",
    [Doubled(Linear()), Unweighted(Linear(), huber=1.0), NoisyCKF(Linear())],
    ids=["correct", "part", "predict"],
)
def test_a_subclass_uses_its_own_methods(estimator):
    record = linear_record()
    base = type(estimator).__mro__[1](Linear(), **estimator.options)
    found = estimator.run(record)
    assert abs(found.xhat - base.run(record).xhat).max() > 1e-4
    assert_same(found, in_numpy(estimator).run(record))
    assert type(estimator).__name__ in compiled_filter(estimator)


@dataclass(frozen=True)
class Renamed(UKF):
    """A subclass with other settings, which is compiled."""

    beta: float = 1.0
    name = "renamed"

    def helper(self):
        return self.beta


@dataclass(frozen=True)
class ManyPoints(CKF):
    """The points of CKF, each twice and rotated."""

    def points(self):
        points, weights, _ = super().points()
        turned = points @ np.array([[0.6, -0.8], [0.8, 0.6]])
        weights = np.append(weights, weights) / 2
        return np.concatenate([points, turned]), weights, weights


@dataclass(frozen=True)
class TurnedPoints(CKF):
    """The points of CKF, rotated."""

    def points(self):
        points, weights, cov_weights = super().points()
        return points @ np.array([[0.6, -0.8], [0.8, 0.6]]), weights, cov_weights


def test_a_subclass_with_other_settings_or_points():
    record = beginning("ReverseDuffing")
    for kind in (Renamed, TurnedPoints):
        estimator = kind(ReverseDuffing())
        assert estimator.compiled is not None
        assert_near(estimator.run(record), in_numpy(estimator).run(record))
    estimator = ManyPoints(ReverseDuffing())
    assert compiled_filter(estimator) == "it has 8 points, more than 5"
    assert_same(estimator.run(record), in_numpy(estimator).run(record))


@dataclass(frozen=True, eq=False)
class Rising(Noise):
    """Output noise that grows with time."""

    def G(self, t):
        return (1 + t) * super().G(0.0)


@dataclass(frozen=True)
class LouderLinear(Linear):
    def noise(self, noise_std=None, process_noise=None):
        own = super().noise(noise_std, process_noise)
        return Rising(own.process, own.output, own.samples)


@KINDS
def test_noise_with_methods_of_its_own_is_that_of_numpy(kind):
    record, estimator = linear_record(), kind(LouderLinear())
    assert compiled_filter(estimator) == "its noise has methods of its own"
    assert_same(estimator.run(record), in_numpy(estimator).run(record))
    assert abs(estimator.run(record).S - kind(Linear()).run(record).S).max() > 0.01


@KINDS
def test_rows_go_through_numpy_and_come_back(kind, monkeypatch):
    """The cases above leave samples to NumPy: not all, in not all rows, and not all that follow."""
    calls = []
    original = RecursiveEstimator.update_by_numpy

    def counted(self, state, t, y, u):
        calls.append((len(y), t))
        return original(self, state, t, y, u)

    monkeypatch.setattr(RecursiveEstimator, "update_by_numpy", counted)
    estimator, record = filters(kind, many_plants.bounded_reactor)
    estimator.run(record)
    rows = sum(size for size, _ in calls)
    assert 0 < rows < record.batch * record.num_samples / 2
    # A sample is processed at once in all rows that are left to NumPy at it.
    times = [t for _, t in calls]
    assert times == sorted(set(times))
    calls.clear()
    if kind is not EKF:
        estimator, record = filters(kind, many_plants.well)
        estimator.run(record)
        assert calls


@KINDS
def test_what_does_not_fit_is_refused_as_in_numpy(kind):
    plants = many_plants.cart_of_each_row, many_plants.cart_with_noise_by_sample
    for plant, rows in itertools.product(plants, (np.arange(2), np.repeat(np.arange(6), 2))):
        estimator, record = filters(kind, plant, 6)
        part = replace(record, noise_std=None).rows(rows)
        for each in (estimator, in_numpy(estimator)):
            with pytest.raises(ValueError, match="broadcast"):
                each.run(part)
            with pytest.raises(ValueError, match="broadcast"):
                steps(each, part)
    state = replace(estimator.reset(record.prior), P=None)
    with pytest.raises(ValueError, match="reset"):
        estimator.update(state, 0.0, record.y[:, 0], record.u[:, 0])


@KINDS
@pytest.mark.parametrize("batch", [1, 3])
def test_outputs_of_other_types_and_layouts(kind, batch):
    estimator, record = filters(kind, many_plants.cart_with_measured_input, batch)
    state = steps(estimator, record, 3)[-1]
    t, y, u = float(record.t[3]), np.round(record.y[:, 3]), np.round(record.u[:, 3])
    y = np.nan_to_num(y)
    expected = estimator.update(state, t, y, u)
    for change in (np.ndarray.tolist, np.float32, np.asfortranarray, np.int64):
        found = estimator.update(state, np.float64(t), change(y), change(u))
        np.testing.assert_array_equal(found.xhat, expected.xhat)
    two = np.repeat(y, 2, axis=1)[:, ::2], np.repeat(u, 2, axis=0)[::2]
    np.testing.assert_array_equal(estimator.update(state, t, *two).xhat, expected.xhat)


def test_kernels_are_turned_off(monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    assert UKF(ReverseDuffing()).compiled is None
    assert "PINNOBS_KERNELS=0" in str(compiled_filter(EKF(Linear())))


def test_an_update_refuses_inputs_that_the_model_does_not_use():
    """Also in rows beyond the first, whose numbers are the same."""
    system = SYSTEMS.resolve("InductionMotor")()
    estimator = EKF.for_setup(system, system.setups["benchmark"])
    assert estimator.compiled is not None
    state = estimator.reset(Prior.of(system, system.setups["benchmark"], 3))
    u = np.repeat(system.input(np.zeros(1)), 3, axis=0)
    state = estimator.update(state, 0.0, np.zeros((3, 2)), u)
    u = np.repeat(system.input(np.full(1, 1e-3)), 3, axis=0)
    estimator.update(state, 1e-3, np.zeros((3, 2)), u * (1 + 5e-7))  # as rounded to few digits
    u[2, 1] += 1.0
    with pytest.raises(ValueError, match=r"input u2=.* is not that of InductionMotor.input"):
        estimator.update(state, 1e-3, np.zeros((3, 2)), u)


@KINDS
def test_an_array_of_one_number_holds_for_all_rows(kind):
    system, record = played(many_plants.cart, 9)
    estimator = kind(replace(system, drag=np.array([0.3]), gain=np.array([0.8])))
    assert estimator.compiled is not None
    assert_same(estimator.run(record), kind(system).run(record))
    assert_same(stacked(steps(estimator, record, 5)), stacked(steps(kind(system), record, 5)))


@KINDS
def test_no_rows(kind):
    estimator = kind(many_plants.Escape())
    assert estimator.compiled is not None
    prior = Prior(np.zeros((0, 2)), np.zeros((0, 2, 2)))
    state = estimator.reset(prior)
    for t in (0.0, 0.1):
        state = estimator.update(state, t, np.zeros((0, 2)), np.zeros((0, 0)))
        assert state.xhat.shape == (0, 2)


@dataclass(frozen=True)
class Sensed(many_plants.Henon):
    """Its sensor has a gain."""

    sensitivity: float = 1.0

    def h(self, t, x, u):
        return stack(x, self.sensitivity * x[..., 0])


@KINDS
def test_outputs_that_depend_on_numbers_of_rows(kind, caplog):
    gains = np.linspace(0.5, 1.5, 3)
    system, t = Sensed(sensitivity=gains), np.arange(8.0)
    record = many_plants.simulated(system, t, 3, missing=0.0)
    estimator = kind(system)
    assert estimator.compiled is not None
    found = estimator.run(record)
    assert_near(found, in_numpy(estimator).run(record))
    for i, gain in enumerate(gains):
        alone = kind(Sensed(sensitivity=gain)).run(record.rows(np.array([i])))
        assert_same(alone, Estimates(*(getattr(found, name)[i : i + 1] for name in FIELDS)))
    assert "differentiated" not in caplog.text
