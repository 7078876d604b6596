"""Ensembles and particles in compiled code against the same in NumPy, which is the reference."""

import copy
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
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor

pytestmark = needs_compiler
BOTH = pytest.mark.parametrize("kind", [EnKF, ParticleFilter])
BATCH = 7

played = cache(lambda plant: plant(BATCH))  # a plant and its record, which do not change


def in_numpy(estimator):
    """The same estimator without compiled code."""
    other = replace(estimator)
    vars(other)["compiled"] = None
    return other


def estimator_of(kind, plant, **options):
    system, record = played(plant)
    level = None if record.noise_std is None else SampledLevel(record.t, record.noise_std)
    estimator = kind(system, level, **options)
    assert estimator.compiled is not None, compiled_filter(estimator)
    return estimator, record


@cache
def whole_run(kind, plant):
    """The estimates of a record in compiled code."""
    estimator, record = estimator_of(kind, plant)
    return estimator.run(record)


def steps(estimator, record, state=None, first=0, last=None):
    """The states after each sample, from `Estimator.update`."""
    state = estimator.reset(record.prior) if state is None else state
    states = []
    with np.errstate(all="ignore"):
        for k in range(first, record.num_samples if last is None else last):
            state = estimator.update(state, float(record.t[k]), record.y[:, k], record.u[:, k])
            states.append(state)
    return states


def stacked(states):
    return Estimates(*(np.stack([getattr(s, name) for s in states], axis=1) for name in FIELDS))


@BOTH
@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_it_agrees_with_numpy_on_each_system(kind, name, monkeypatch):
    source = EpisodeSource(name)
    record = record_of(source, 2).first_samples(40)
    estimator = kind.for_setup(source.system, source.setup)
    assert estimator.compiled is not None
    expected = in_numpy(estimator).run(record)
    monkeypatch.delattr(RecursiveEstimator, "update_by_numpy")  # it is not needed
    assert_near(estimator.run(record), expected)


@BOTH
@pytest.mark.parametrize("plant", [p for p in many_plants.PLANTS if p is not many_plants.escape])
def test_it_agrees_with_numpy(kind, plant):
    """Irregular times, missing outputs, maps, inputs, angles, bounds, tables, wide priors."""
    estimator, record = estimator_of(kind, plant)
    assert_near(whole_run(kind, plant), in_numpy(estimator).run(record))


@BOTH
def test_it_agrees_with_numpy_until_rows_diverge(kind):
    """Rounding errors grow without bound as states do, in half a sample from 10 to infinity."""
    estimator, record = estimator_of(kind, many_plants.escape)
    found, expected = whole_run(kind, many_plants.escape), in_numpy(estimator).run(record)
    near = np.logical_and.accumulate(abs(expected.xhat).max(axis=-1) < 10, axis=1)
    assert 0.1 < near.mean() < 0.95
    np.testing.assert_allclose(found.xhat[near], expected.xhat[near], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(np.isfinite(found.xhat), np.isfinite(expected.xhat))


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (EnKF, {"members": 2}),
        (EnKF, {"members": 8, "inflation": 1.0, "seed": 2**40 + 3}),
        (EnKF, {"members": 23, "inflation": 1.5, "assumed_noise": 0.0, "seed": 5}),
        (ParticleFilter, {"particles": 2}),
        (ParticleFilter, {"particles": 20, "seed": 2**40 + 3}),
        (ParticleFilter, {"particles": 203, "discount": 0.9, "process_noise": 0.0}),
        (ParticleFilter, {"particles": 64, "discount": 1.0}),
        (ParticleFilter, {"particles": 300, "process_noise": 1e-3}),
    ],
)
@pytest.mark.parametrize("plant", [many_plants.cart, many_plants.bounded_reactor])
def test_it_agrees_with_numpy_under_other_settings(kind, options, plant):
    estimator, record = estimator_of(kind, plant, **options)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))


@BOTH
@pytest.mark.parametrize("plant", many_plants.PLANTS)
def test_a_row_is_the_same_alone_and_in_any_batch(kind, plant):
    system, record = played(plant)
    whole = whole_run(kind, plant)
    for rows in (np.array([3]), np.array([1, 4, 6])):
        part = record.rows(rows)
        own = {n: v[rows] for n, v in system.parameters.items() if np.ndim(v)}
        found = kind(replace(system, **own)).run(part)
        assert_same(found, Estimates(*(getattr(whole, name)[rows] for name in FIELDS)))


@BOTH
@pytest.mark.parametrize("plant", [many_plants.well, many_plants.escape])
def test_a_row_in_numpy_is_the_same_alone_and_in_any_batch(kind, plant):
    """Also beside rows in which outputs are not defined at some points, or points overflow."""
    estimator, record = in_numpy(kind(played(plant)[0])), played(plant)[1]
    whole, rows = estimator.run(record), np.array([0, 3])
    expected = Estimates(*(getattr(whole, name)[rows] for name in FIELDS))
    assert_same(estimator.run(record.rows(rows)), expected)


@BOTH
@pytest.mark.parametrize("plant", [many_plants.cart_with_joined_input, many_plants.henon])
def test_either_goes_on_from_a_state_of_the_other(kind, plant):
    estimator, record = estimator_of(kind, plant)
    other, middle, expected = in_numpy(estimator), record.num_samples // 2, whole_run(kind, plant)
    assert_same(stacked(steps(estimator, record)), expected)
    for first, second in ((estimator, other), (other, estimator)):
        before = steps(first, record, last=middle)
        after = steps(second, record, before[-1], first=middle)
        assert_near(stacked([*before, *after]), expected)


@BOTH
def test_copies_of_states_and_estimators(kind):
    estimator, record = estimator_of(kind, many_plants.bounded_reactor)
    before, state, expected = steps(estimator, record, last=6)[-3:]
    for copied in (copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))):
        found = steps(copied(estimator), record, copied(state), 5, 6)[-1]
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    # A state is not changed by what follows from it.
    again = steps(estimator, record, before, 4, 5)[-1]
    np.testing.assert_array_equal(again.xhat, state.xhat)
    # The points of a state count, if they are others.
    memory = state.memory
    points = "members" if kind is EnKF else "particles"
    moved = replace(memory, **{points: 0.9 * getattr(memory, points) + 0.3})
    moved = replace(state, memory=moved)
    found = [steps(each, record, moved, 5, 6) for each in (estimator, in_numpy(estimator))]
    assert_near(*map(stacked, found))
    assert abs(found[0][0].xhat - expected.xhat).max() > 0.01


@BOTH
def test_threads_share_an_estimator(kind):
    estimator, record = estimator_of(kind, many_plants.cart)
    expected, found = whole_run(kind, many_plants.cart), [None] * 3

    def work(i):
        found[i] = estimator.run(record)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(found))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for each in found:
        assert_same(each, expected)


@pytest.mark.parametrize(
    ("kind", "plant"), [(EnKF, many_plants.bounded_reactor), (ParticleFilter, many_plants.well)]
)
def test_rows_go_through_numpy_and_come_back(kind, plant, monkeypatch):
    calls = []
    original = RecursiveEstimator.update_by_numpy

    def counted(self, state, t, y, u):
        calls.append(len(y))
        return original(self, state, t, y, u)

    monkeypatch.setattr(RecursiveEstimator, "update_by_numpy", counted)
    estimator, record = estimator_of(kind, plant)
    estimator.run(record)
    assert 0 < sum(calls) < record.batch * record.num_samples / 2
    assert len(calls) <= record.num_samples


def test_localised_covariances_are_those_of_numpy():
    @dataclass(frozen=True)
    class Apart(Linear):
        def distances(self):
            return np.ones((self.nx, self.nx)), np.ones((self.nx, self.ny))

    assert compiled_filter(EnKF(Apart(), localisation=3.0)) == "its covariances are localised"


def test_collapses_are_counted_without_tempering():
    """Of 20 particles, 2 are enough for the likelihood not to be tempered, and 5 no collapse."""
    record = linear_record(2)
    estimator = ParticleFilter(Linear(), noise_std=0.02, particles=20)
    both = estimator, in_numpy(estimator)
    counted = [steps(each, record)[-1].memory.collapses for each in both]
    np.testing.assert_array_equal(*counted)
    assert counted[0].max() > 0


@BOTH
def test_an_update_refuses_what_the_model_does_not_use(kind):
    estimator = kind.for_setup(*InductionMotor.configured())
    record = record_of(EpisodeSource("InductionMotor"), 1)
    state = estimator.reset(record.prior)
    for k in range(2):
        with pytest.raises(ValueError, match=r"is not that of InductionMotor\.input"):
            estimator.update(state, float(record.t[k]), record.y[:, k], record.u[:, k] + 1.0)
        state = estimator.update(state, float(record.t[k]), record.y[:, k], record.u[:, k])
    with pytest.raises(ValueError, match="expected at most 100000 between two samples"):
        estimator.update(state, 1e9, record.y[:, 2], InductionMotor().input(np.array([1e9])))
