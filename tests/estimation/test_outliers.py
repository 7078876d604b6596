"""Outputs of which some are outliers: gains and densities against the mixture of two Gaussians."""

import numpy as np
import pytest
from linear import Linear
from scipy.stats import multivariate_normal, norm

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.outliers import OutlierLaw, log_density
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.record import Prior, Record

RATE, SIZE = 0.05, 20.0


def mixture(e, prior, noise):
    """Density, mean and posterior probability of an outlier of a scalar state with this variance
    of the prior, measured with an innovation e."""
    S = prior + noise, prior + SIZE**2 * noise
    parts = [p * norm.pdf(e, scale=np.sqrt(s)) for p, s in zip((1 - RATE, RATE), S, strict=True)]
    total = sum(parts)
    mean = sum(part / total * prior / s * e for part, s in zip(parts, S, strict=True))
    return total, mean, parts[1] / total


@pytest.mark.parametrize("e", [0.0, 0.3, 1.0, 2.5, -8.0])
def test_the_gain_is_the_mean_of_the_gains_of_both_cases(e):
    prior, noise = 0.04, 0.01
    S, R = np.full((1, 1, 1), prior + noise), np.full((1, 1, 1), noise)
    used = OutlierLaw(RATE, SIZE).inflated(np.array([[e]]), S, R)[0, 0, 0]
    density, mean, _ = mixture(e, prior, noise)
    assert prior / (prior + used) * e == pytest.approx(mean, rel=1e-12)
    found = log_density(np.array([[e]]), S, R, np.zeros((1, 1), bool), RATE, SIZE)
    assert found[0] == pytest.approx(np.log(density), rel=1e-12)


def test_without_outliers_the_density_is_that_of_correlated_gaussians():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 3))
    S, R, e = root @ root.T + np.eye(3), np.eye(3), rng.standard_normal((3, 5))
    missing = np.zeros((3, 5), bool)
    missing[1, 3] = missing[:, 4] = True
    e[missing] = 0.0
    with np.errstate(divide="ignore"):
        found = log_density(e, np.repeat(S[..., None], 5, 2), R[..., None], missing, 0.0, SIZE)
    for k in range(5):
        rows = np.flatnonzero(~missing[:, k])
        exact = multivariate_normal(cov=S[np.ix_(rows, rows)]).logpdf(e[rows, k]) if k < 4 else 0
        assert found[k] == pytest.approx(exact, rel=1e-10)


def test_a_filter_and_its_compiled_code_update_by_that_gain():
    """On a linear plant the mean after the first sample is that of the mixture."""
    record = Record(
        np.array([0.0, 0.1]),
        np.array([[[0.9, np.nan], [np.nan, np.nan]], [[30.0, np.nan], [np.nan, np.nan]]]),
        np.zeros((2, 2, 0)),
        Prior(np.zeros((2, 2)), np.tile(np.diag([0.04, 0.5]), (2, 1, 1))),
    )
    estimator = UKF(Linear(), 0.1, outliers=RATE, outlier_size=SIZE, assumed_noise=0.0)
    means = [mixture(e, 0.04, 0.01)[1] for e in (0.9, 30.0)]
    np.testing.assert_allclose(estimator.run(record).xhat[:, 0, 0], means, rtol=1e-9)
    state = estimator.reset(record.prior)
    state = estimator.update_by_numpy(state, 0.0, record.y[:, 0], record.u[:, 0])
    np.testing.assert_allclose(state.xhat[:, 0], means, rtol=1e-9)
    assert state.S[0, 0, 0] == pytest.approx(0.05)  # that of a usual sample


def test_compiled_code_agrees_on_episodes_with_outliers():
    game = Game.of("InductionMotor", condition="outliers", duration=0.2)
    setup = game.source.setup
    estimator = UKF(game.source.system, setup.noise_std, setup.process_noise, outliers=0.01)
    record = game.record(range(3))
    found, state = estimator.run(record), estimator.reset(record.prior)
    for k, t in enumerate(record.t):
        state = estimator.update_by_numpy(state, float(t), record.y[:, k], record.u[:, k])
        scale = np.array(game.source.system.scale)
        np.testing.assert_allclose(state.xhat / scale, found.xhat[:, k] / scale, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"outliers": 0.0}, "outliers=0.0; expected a probability between 0 and 1"),
        ({"outliers": 1.5}, "outliers=1.5; expected a probability between 0 and 1"),
        ({"outliers": 0.1, "outlier_size": 1.0}, "outlier_size=1.0; expected a number above 1"),
    ],
)
def test_other_laws_are_refused_in_a_line(options, line):
    with pytest.raises(ValueError, match=f"^{line}$"):
        UKF(Linear(), 0.1, **options)
