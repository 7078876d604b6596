"""The prior that estimators are told is that of the initial states; other quadratures check it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.initial_set import prior_moments, set_moments
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.start_law import Gaussian, Points
from pinnobs_gym.simulation.system import PoorPrior, Setup, System, independent, stack
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.satellite import Satellite


def middles(low, high, count):
    """The middles of as many equal parts of an interval."""
    return low + (high - low) * (np.arange(count) + 0.5) / count


def from_slices(outer, inner, low, high):
    """Moments of a set given by slices, by the midpoint rule over the outer coordinates and by hand
    over the inner one, which is low ≤ abs ≤ high.

    Args:
        outer: the outer coordinates at the points, by their index.
        inner: index of the inner coordinate.
        low: bound of the slices.
        high: bound of the slices; they are empty where it is below low.
    """
    high = np.maximum(high, low)
    length, second = 2 * (high - low), 2 * (high**3 - low**3) / 3
    total, n = length.sum(), len(outer) + 1
    mean, square = np.zeros(n), np.zeros((n, n))
    square[inner, inner] = second.sum() / total
    for i, a in outer.items():
        mean[i] = (length * a).sum() / total
        for j, b in outer.items():
            square[i, j] = (length * a * b).sum() / total
    return mean, square - np.outer(mean, mean)


def root(values):
    return np.sqrt(np.maximum(values, 0.0))


def reverse_duffing():
    x2 = middles(-1.8, 1.8, 10**6)  # 0.25 ≤ x₁²/2 + x₂⁴/4 ≤ 2.5
    low, high = root(0.5 - x2**4 / 2), np.minimum(2.2, root(5 - x2**4 / 2))
    return from_slices({1: x2}, 0, low, high)


def harmonic_oscillator():
    x2, x3 = np.meshgrid(middles(-2, 2, 2000), middles(0.5, 6, 2000))
    ratio = x2**2 / x3  # 0.5 ≤ x₁² + x₂²/x₃ ≤ 4
    return from_slices({1: x2, 2: x3}, 0, root(0.5 - ratio), np.minimum(2, root(4 - ratio)))


def academic():
    x1 = middles(-2, 2, 10**6)  # 0.3 ≤ abs(x₂)·√(1 + x₁²) ≤ 2.5
    slope = np.sqrt(1 + x1**2)
    return from_slices({0: x1}, 1, 0.3 / slope, np.minimum(1.5, 2.5 / slope))


def modified_academic():
    x1 = middles(-3, 3, 10**5)
    return from_slices({0: x1}, 1, np.full(x1.shape, 0.1), np.full(x1.shape, 1.5))


def satellite():
    x1, x3 = np.meshgrid(middles(-2, 2, 2000), middles(1, 3, 2000))
    inside = 1 * (1 - 0.8) * x1**2 < 0.8 * 0.3 * (0.8 - 0.3) * x3**2
    low = np.maximum(0.5 - abs(x1), 0.0)
    return from_slices({0: x1, 2: x3}, 1, low, np.where(inside, 2.0, 0.0))


def induction_motor():
    half = np.array([5, 5, 0.5, 0.5, 100])
    return np.array([0, 0, 0, 0, 100.0]), np.diag(half**2 / 3)


SETS = {
    "ReverseDuffing": reverse_duffing,
    "HarmonicOscillator": harmonic_oscillator,
    "Academic": academic,
    "ModifiedAcademic": modified_academic,
    "Satellite": satellite,
    "InductionMotor": induction_motor,
}


def test_every_system_has_a_quadrature_here():
    assert set(SETS) == set(SYSTEMS.classes())


@pytest.mark.parametrize("name", SETS)
def test_the_benchmarks_prior_is_that_of_its_set_to_four_digits(name):
    setup, moments = SYSTEMS.resolve(name).setups["benchmark"], SETS[name]()
    for stated, found in zip((setup.xhat0, setup.P0), moments, strict=True):
        stated, zero = np.array(stated), abs(found) < 1e-9
        assert (stated[zero] == 0).all()  # by symmetry, exactly
        digit = 10.0 ** (np.floor(np.log10(abs(found[~zero]))) - 3)
        assert (abs(stated[~zero] - found[~zero]) < 0.55 * digit).all()  # rounded, and its error


@pytest.mark.parametrize("name", SETS)
def test_the_benchmarks_prior_is_that_of_the_states_drawn(name):
    """Within four standard errors of 2,000 episodes."""
    source, count = EpisodeSource(name, duration=0.1), 2000
    x0 = source.draw(source.streams(range(count))).x0
    mean, cov = prior_moments(source.system, source.setup)
    std = np.sqrt(np.diag(cov))
    assert (abs(x0.mean(axis=0) - mean) < 4 * std / np.sqrt(count)).all()
    assert (abs(np.cov(x0.T) - cov) < 4 * np.outer(std, std) / np.sqrt(count)).all()


@pytest.mark.parametrize("name", SETS)
def test_the_default_is_computed_as_precisely(name):
    system, setup = SYSTEMS.resolve(name).configured()
    setup = replace(setup, xhat0=None, P0=None)
    (mean, cov), (exact_mean, exact_cov) = prior_moments(system, setup), SETS[name]()
    std = np.sqrt(np.diag(exact_cov))
    assert (abs(mean - exact_mean) < 1e-4 * std).all()
    assert (abs(cov - exact_cov) < 1e-4 * np.outer(std, std)).all()
    assert (mean[abs(exact_mean) < 1e-9] == 0).all()
    assert (cov[~np.eye(len(cov), dtype=bool)] == 0).all()


@dataclass(frozen=True)
class Half(Satellite):
    """Only states whose first component is not negative are admissible."""

    def admissible(self, x0):
        return x0[..., 0] >= 0


def half_normal(cov):
    """Mean and covariance of N(0, cov) given that the first component is not negative, in which
    the others are linear but for a remainder that is independent of it."""
    slope = cov[:, 0] / cov[0, 0]
    mean = slope * np.sqrt(2 * cov[0, 0] / np.pi)
    return mean, cov - np.outer(slope, slope) * cov[0, 0] * 2 / np.pi


@pytest.mark.parametrize(
    "root",
    [
        [[1.5, 0.0, 0.0], [0.4, 0.6, 0.0], [-0.3, 0.2, 0.5]],
        [[2.0], [1.0], [-0.5]],  # singular: a line
        [[0.5, 0.0], [0.0, 0.0], [0.7, 1.0]],  # singular: the second is known
    ],
)
def test_a_restricted_gaussian_is_told_as_it_is_drawn(root):
    cov = np.array(root) @ np.array(root).T
    law = Gaussian((0.0, 2.0, 2.0), tuple(map(tuple, cov.tolist())))
    setup = Setup(x0_law=law, duration=1.0, dt=0.1)
    mean, P = prior_moments(Half(), setup)
    expected_mean, expected = half_normal(cov)
    std = np.sqrt(np.diag(cov))
    assert (abs(mean - law.mean - expected_mean) <= 5e-3 * std).all()
    assert (abs(P - expected) <= 5e-3 * np.outer(std, std)).all()
    assert np.linalg.matrix_rank(P, tol=1e-9) == np.linalg.matrix_rank(cov)
    again = prior_moments(Half(), replace(setup, dt=0.2))
    np.testing.assert_array_equal(again[0], mean)
    np.testing.assert_array_equal(again[1], P)
    free = prior_moments(Free(), setup)
    np.testing.assert_array_equal(free[0], law.mean)
    np.testing.assert_array_equal(free[1], law.cov)


@dataclass(frozen=True)
class Free(Satellite):
    admissible = System.admissible


def test_a_restricted_list_is_told_as_it_is_drawn():
    law = Points(((-1.0, 0.0, 2.0), (1.0, 3.0, 2.0), (2.0, 1.0, 2.0)))
    mean, P = prior_moments(Half(), Setup(x0_law=law, duration=1.0, dt=0.1))
    np.testing.assert_allclose(mean, (1.5, 2.0, 2.0))
    np.testing.assert_allclose(P, [[0.25, -0.5, 0.0], [-0.5, 1.0, 0.0], [0.0, 0.0, 0.0]])


def test_a_gaussian_of_no_admissible_state_is_refused():
    law = Gaussian((-9.0, 2.0, 2.0), independent(0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match=r"^Half: none of \d+ states is admissible; x₀ Gaussian"):
        prior_moments(Half(), Setup(x0_law=law, duration=1.0, dt=0.1))


@dataclass(frozen=True)
class Oblique(System):
    """Two states, the second at first no less than the first; and one that is known exactly."""

    state_names = ("a", "b", "c")
    output_names = ("y",)
    scale = (1.0, 1.0, 1.0)
    setups = {"benchmark": Setup((0, 0, 7), (1, 1, 7), duration=1.0, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        return stack(x, x[..., 1], -x[..., 0], 0.0)

    def h(self, t, x, u):
        return x[..., :1]

    def admissible(self, x0):
        return x0[..., 1] >= x0[..., 0]


BENCHMARK = Oblique.setups["benchmark"]


def test_a_users_set_has_its_prior_without_any_numbers():
    """A triangle: mean (1/3, 2/3), variance 1/18, covariance 1/36."""
    source = EpisodeSource(Oblique)
    prior = source.record(source.play(source.draw(source.streams([0, 1])))).prior
    np.testing.assert_allclose(prior.mean, [[1 / 3, 2 / 3, 7]] * 2, rtol=1e-4)
    expected = np.array([[1 / 18, 1 / 36, 0], [1 / 36, 1 / 18, 0], [0, 0, 0]])
    np.testing.assert_allclose(prior.cov, [expected] * 2, atol=1e-5)


def test_the_moments_of_a_set_are_computed_once():
    corners = (0.0, 0.0, 7.0), (1.0, 1.0, 7.0)
    first = set_moments(Oblique(), *corners)
    assert set_moments(Oblique(), *corners) is first
    with pytest.raises(ValueError, match="read-only"):
        first[1][0, 0] = 1.0


def test_the_moments_in_five_dimensions():
    """A ball of radius 1, each variance of which is 1/(5 + 2)."""

    class Ball(Oblique):
        state_names = ("a", "b", "c", "d", "e")

        def admissible(self, x0):
            return (x0**2).sum(axis=-1) <= 1

    mean, cov = set_moments(Ball(), (-1.0,) * 5, (1.0,) * 5)
    assert (mean == 0).all()
    np.testing.assert_allclose(cov, np.eye(5) / 7, atol=2e-3 / 7)


def test_an_empty_set_is_one_clear_line():
    class Empty(Oblique):
        def admissible(self, x0):
            return x0[..., 1] > 5

    with pytest.raises(
        ValueError, match=r"^Empty: none of 4194304 states of the box is admissible"
    ):
        Prior.of(Empty(), BENCHMARK, 1)


def test_one_of_mean_and_covariance_may_be_given():
    mean, cov = prior_moments(Oblique(), replace(BENCHMARK, xhat0=(0.5, 0.5, 7.0)))
    np.testing.assert_array_equal(mean, [0.5, 0.5, 7.0])
    assert cov[0, 1] == pytest.approx(1 / 36, rel=1e-3)
    mean, cov = prior_moments(Oblique(), replace(BENCHMARK, P0=independent(1.0, 2.0, 0.0)))
    assert mean[0] == pytest.approx(1 / 3, rel=1e-3)
    np.testing.assert_array_equal(cov, np.diag([1.0, 4.0, 0.0]))


def test_correlations_reach_the_estimators():
    P0 = ((0.1, 0.05, 0.0), (0.05, 0.2, 0.0), (0.0, 0.0, 0.0))
    prior = Prior.of(Oblique(), replace(BENCHMARK, P0=P0), 2)
    np.testing.assert_array_equal(prior.cov, [P0] * 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x0_high": (0, 0, 7)}, "the initial state is fixed, .* give xhat0$"),
        ({"x0_high": (0, 0, 7), "xhat0": (0, 0, 0)}, "the initial state is fixed, .* give P0$"),
        ({"P0": ((1.0, 2.0),)}, "expected a covariance, as many rows as columns"),
        ({"P0": (1.0, 2.0, 1.0)}, "expected a covariance, as many rows as columns"),
        ({"P0": ((1.0, 0.5), (0.0, 1.0))}, "expected a covariance, symmetric and finite"),
        ({"P0": ((1.0, 0.0), (0.0, float("nan")))}, "expected a covariance, symmetric and finite"),
        ({"P0": ((1.0, 2.0), (2.0, 1.0))}, "expected a covariance, without eigenvalues below 0"),
    ],
)
def test_what_is_no_prior_is_one_clear_line(changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        replace(BENCHMARK, **changes)
    assert "\n" not in str(caught.value)


def test_what_is_no_poor_prior_is_refused_as_well():
    with pytest.raises(ValueError, match="expected a covariance, without eigenvalues below 0"):
        PoorPrior((0, 0), ((1.0, 2.0), (2.0, 1.0)))
    with pytest.raises(ValueError, match=r"standard deviations \(-1.0,\); expected numbers"):
        independent(-1.0)


@pytest.mark.parametrize("where", ["setup", "poor prior"])
def test_a_prior_of_another_size_is_refused(where):
    small = PoorPrior((0, 0, 0), independent(1.0, 1.0))
    changes = {"P0": small.P0} if where == "setup" else {"poor_prior": small}

    class Wrong(Oblique):
        setups = {"benchmark": replace(BENCHMARK, **changes)}

    with pytest.raises(TypeError, match=r"P0 of setup 'benchmark' has shape \(2, 2\)"):
        Wrong.validate()


@pytest.mark.parametrize("kind", [EKF, UKF, CKF, EnKF, MHE])
def test_filters_work_with_a_state_that_is_known_exactly(kind):
    source = EpisodeSource(Oblique)
    episodes = source.play(source.draw(source.streams(range(3))))
    estimates = kind.for_setup(source.system, source.setup).run(source.record(episodes))
    assert np.isfinite(estimates.xhat).all()
    errors = estimates.xhat - episodes.x[:-1].swapaxes(0, 1)
    assert abs(errors[:, -1]).max() < 0.3


@pytest.mark.parametrize("mode", ["gain", "correction", "normalized"])
def test_forms_of_actions_work_with_a_state_that_is_known_exactly(mode):
    env = EstimationEnv(Oblique, action_mode=mode)
    observation, _ = env.reset(seed=0)
    assert np.isfinite(observation).all()
    observation, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)


def test_the_paper_setups_tell_what_the_paper_says():
    mean, cov = prior_moments(*Satellite.configured("paper"))
    np.testing.assert_array_equal(mean, [1, 1, 2])
    np.testing.assert_allclose(cov, np.diag([2.25, 2.25, 1.0]))
