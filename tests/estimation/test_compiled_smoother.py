"""The compiled smoother against the same in NumPy, and against a batch solution."""

from dataclasses import dataclass, replace
from functools import cache

import many_plants
import numpy as np
import pytest
from agreement import FIELDS, assert_near, assert_same
from array_api_compat import array_namespace
from fake_compilers import needs_compiler
from linear import H as OUTPUTS
from linear import Linear, linear_record, record_of, runge_kutta_matrix

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.compiled_smoother import compiled_smoother
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimation.smoother import LEAST, forward
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.systems import SYSTEMS

pytestmark = needs_compiler
PLANTS = pytest.mark.parametrize("plant", many_plants.PLANTS)
played = cache(lambda plant, batch: plant(batch))  # a plant and its record, which do not change


def in_numpy(smoother):
    """The same smoother without compiled code."""
    other = replace(smoother)
    vars(other)["compiled"] = None
    return other


def smoother_of(plant, batch, **options):
    """The smoother of a plant, which is compiled, and a record."""
    system, record = played(plant, batch)
    level = None if record.noise_std is None else SampledLevel(record.t, record.noise_std)
    smoother = RTSSmoother(system, level, **options)
    assert smoother.compiled is not None, compiled_smoother(smoother)
    return smoother, record


def left_of(smoother, record):
    """The numbers of the rows that compiled code leaves to NumPy."""
    return set(smoother.compiled.run(record)[1].tolist())


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_it_agrees_with_numpy_on_each_system(name):
    source = EpisodeSource(name)
    record, smoother = record_of(source, 2), RTSSmoother.for_setup(source.system, source.setup)
    n = min(record.num_samples, 150)
    record = replace(record, t=record.t[:n], y=record.y[:, :n], u=record.u[:, :n])
    assert smoother.compiled is not None
    assert not left_of(smoother, record)
    assert_near(smoother.run(record), in_numpy(smoother).run(record))


@PLANTS
@pytest.mark.parametrize("options", [{}, {"assumed_noise": 0.1}])
def test_it_agrees_with_numpy(plant, options):
    smoother, record = smoother_of(plant, 20, **options)
    assert_near(smoother.run(record), in_numpy(smoother).run(record))


@PLANTS
def test_a_row_is_the_same_alone_and_in_any_batch(plant):
    smoother, record = smoother_of(plant, 60)
    whole, level = smoother.run(record), smoother.noise_std
    for size in (1, 2, 3, 4, 5, 8):
        rows = np.arange(60 - size, 60) if size % 2 else np.arange(0, 60, 60 // size)[:size]
        own = {n: v[rows] for n, v in smoother.system.parameters.items() if np.ndim(v)}
        noise = None if level is None else level.rows(rows)
        found = RTSSmoother(replace(smoother.system, **own), noise).run(record.rows(rows))
        expected = [getattr(whole, name) for name in FIELDS]
        assert_same(found, Estimates(*(None if e is None else e[rows] for e in expected)))


def test_it_is_the_batch_solution():
    """Of a linear plant: the normal distribution of all states, given all outputs."""
    record, smoother = linear_record(5), RTSSmoother(Linear(), process_noise=0.3)
    record.y[2, 4:9, 1] = np.nan
    record.y[3, 7] = np.nan
    assert not left_of(smoother, record)
    found, n = smoother.run(record), record.num_samples
    F = runge_kutta_matrix(0.1)
    Q = forward(Linear(), record, smoother.noise).Q[0, ..., 0]
    for row in range(record.batch):
        information, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
        information[:2, :2] = np.linalg.inv(record.prior.cov[row])
        right[:2] = information[:2, :2] @ record.prior.mean[row]
        for k in range(n):
            at = slice(2 * k, 2 * k + 2)
            seen = np.isfinite(record.y[row, k])
            C = OUTPUTS[seen]
            information[at, at] += C.T @ C / 0.01
            right[at] += C.T @ record.y[row, k, seen] / 0.01
            if k:
                defect = np.zeros((2, 2 * n))
                defect[:, at], defect[:, 2 * k - 2 : 2 * k] = np.eye(2), -F
                information += defect.T @ np.linalg.inv(Q) @ defect
        cov = np.linalg.inv(information)
        np.testing.assert_allclose(found.xhat[row].ravel(), cov @ right, atol=1e-11)
        for k in range(n):
            at = slice(2 * k, 2 * k + 2)
            np.testing.assert_allclose(found.P[row, k], cov[at, at], atol=1e-12)


@dataclass(frozen=True)
class Contracting(System):
    """Its states become nearly dependent where the rate is high, and there is little noise."""

    rate: float = 1.0

    state_names = ("a", "b", "c")
    output_names = ("y",)
    scale = (1.0, 1.0, 1.0)
    setups = {"benchmark": Setup((-1.0,) * 3, (1.0,) * 3, duration=2.0, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, -0.2 * a, self.rate * (a - b), self.rate * (a - c) + 0.1 * b)

    def h(self, t, x, u):
        return x.sum(-1, keepdims=True)


def test_rows_near_to_singular_are_found():
    """They are those of which a predicted covariance has correlations with a small eigenvalue; a
    row that is not one of them is left to NumPy only if it comes near."""
    rate = np.geomspace(4.0, 12.0, 41)
    system = Contracting(rate)
    record = many_plants.simulated(system, 0.1 * np.arange(20), len(rate), missing=0.1)
    smoother = RTSSmoother(system, process_noise=3e-7, assumed_noise=0.0)
    P = forward(system, record, smoother.noise).predicted.P[1:].transpose(3, 0, 1, 2)
    std = np.sqrt(np.einsum("bkii->bki", P))
    least = np.linalg.eigvalsh(P / (std[..., None] * std[..., None, :]))[..., 0].min(axis=1)
    left = left_of(smoother, record)
    assert set(np.flatnonzero(least < LEAST)) <= left <= set(np.flatnonzero(least < 3.1 * LEAST))
    assert 5 < len(left) < 35
    # Just above the bound, the recursion itself is off by 1e-7.
    assert_near(smoother.run(record), in_numpy(smoother).run(record), rtol=1e-6)


@dataclass(frozen=True)
class Chain(System):
    """More states than straight code is written for."""

    state_names = tuple(f"x{i}" for i in range(1, 8))
    output_names = ("y1", "y2")
    scale = (1.0,) * 7
    setups = {"benchmark": Setup((-1.0,) * 7, (1.0,) * 7, duration=2.0, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        xp = array_namespace(x)
        before = [x[..., i - 1] for i in range(7)]
        return stack(x, *(xp.sin(before[i]) - 0.3 * (i + 1) * x[..., i] for i in range(7)))

    def h(self, t, x, u):
        return stack(x, x[..., 0] + x[..., 6], x[..., 3] * x[..., 4])


@pytest.mark.parametrize("kind", [RTSSmoother, EKF])
def test_a_plant_with_many_states(kind):
    system = Chain()
    record = many_plants.simulated(system, many_plants.times(), 6)
    estimator = kind(system, process_noise=0.05)
    assert estimator.compiled is not None
    whole = estimator.run(record)
    assert_near(whole, in_numpy(estimator).run(record))
    alone = estimator.run(record.rows(np.array([4])))
    np.testing.assert_array_equal(alone.xhat[0], whole.xhat[4])
    if kind is RTSSmoother:
        assert not left_of(estimator, record)


def test_wide_priors_of_plants_with_one_number_per_row():
    """The rows that are smoothed by roots have the numbers of these rows."""
    system, record = played(many_plants.cart_of_each_row, 6)
    cov = record.prior.cov.copy()
    cov[[1, 4]] *= 1e14
    record = replace(record, prior=replace(record.prior, cov=cov))
    smoother = RTSSmoother(system)
    found = smoother.run(record)
    assert_near(found, in_numpy(smoother).run(record))
    for row in (1, 4):
        own = RTSSmoother(many_plants.Cart(system.drag[row], system.gain[row]))
        alone = own.run(record.rows(np.array([row])))
        np.testing.assert_allclose(found.xhat[row], alone.xhat[0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("samples", [1, 2])
def test_records_of_one_or_two_samples(samples):
    smoother, record = smoother_of(many_plants.cart, 5)
    part = replace(record, t=record.t[:samples], y=record.y[:, :samples], u=record.u[:, :samples])
    assert_near(smoother.run(part), in_numpy(smoother).run(part))


def test_what_it_is_given_stays_as_it_is():
    smoother, record = smoother_of(many_plants.cart_with_measured_input, 5)
    before = record.y.copy(), record.u.copy(), record.prior.mean.copy(), record.prior.cov.copy()
    first = smoother.run(record)
    kept = first.xhat.copy()
    smoother.run(replace(record, y=record.y + 1.0))
    after = record.y, record.u, record.prior.mean, record.prior.cov
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.xhat, kept)


@dataclass(frozen=True)
class Cautious(RTSSmoother):
    """It uses a method of its own in place of the recursion."""

    def _by_numpy(self, record):
        estimates, near = super()._by_numpy(record)
        return replace(estimates, P=2 * estimates.P), near


def test_a_subclass_uses_its_own_methods():
    record = linear_record()
    found = Cautious(Linear()).run(record)
    np.testing.assert_allclose(found.P, 2 * RTSSmoother(Linear()).run(record).P, rtol=1e-9)
    assert "_by_numpy" in compiled_smoother(Cautious(Linear()))


def test_kernels_are_turned_off(monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    assert "PINNOBS_KERNELS=0" in compiled_smoother(RTSSmoother(Linear()))
    assert RTSSmoother(Linear()).compiled is None


def test_numbers_of_other_rows_are_refused_as_in_numpy():
    smoother, record = smoother_of(many_plants.cart_of_each_row, 6)
    part = record.rows(np.arange(2))
    for each in (smoother, in_numpy(smoother)):
        with pytest.raises(ValueError, match="broadcast"):
            each.run(part)
