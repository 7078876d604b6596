"""Consistency on a linear Gaussian model, where the Kalman filter's covariance is right."""

from dataclasses import replace

import numpy as np
import pytest
from linear import H, Linear, process_covariance, runge_kutta_matrix
from scipy.stats import chi2

from pinnobs_gym import evaluate
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.scoring.consistency import band, consistency
from pinnobs_gym.simulation.record import Prior, Record

BATCH, SAMPLES = 400, 30
PROCESS_NOISE, NOISE = 0.15, 0.1  # per √s and per output


@pytest.fixture(scope="module")
def gaussian():
    """States (batch, num_samples, 2) drawn from the very model that the filter has, and the
    record; a fifth of the outputs are missing."""
    rng = np.random.default_rng(0)
    mean, P0 = np.array([0.3, -0.2]), np.array([[0.6, 0.2], [0.2, 0.3]])
    F, Q = runge_kutta_matrix(0.1), process_covariance(PROCESS_NOISE)
    x = np.empty((BATCH, SAMPLES, 2))
    x[:, 0] = rng.multivariate_normal(mean, P0, BATCH)
    for k in range(1, SAMPLES):
        x[:, k] = x[:, k - 1] @ F.T + rng.multivariate_normal(np.zeros(2), Q, BATCH)
    y = x @ H.T + NOISE * rng.standard_normal(x.shape)
    y[rng.random(y.shape) < 0.2] = np.nan
    prior = Prior(np.tile(mean, (BATCH, 1)), np.tile(P0, (BATCH, 1, 1)))
    return x, Record(np.arange(SAMPLES) * 0.1, y, np.zeros((BATCH, SAMPLES, 0)), prior)


def scores_of(estimator, gaussian):
    x, record = gaussian
    return consistency(x, estimator.run(record), np.isnan(record.y))


def test_a_kalman_filter_is_consistent(gaussian):
    scores = scores_of(EKF(Linear(), NOISE, PROCESS_NOISE, assumed_noise=0.0), gaussian)
    low, high = band(BATCH, 2)
    assert low < scores["anees"].mean() < high
    # innovations are white: their sizes are independent χ², their number that of the outputs
    outputs = (~np.isnan(gaussian[1].y)).sum()
    assert scores["nis"].mean() == pytest.approx(1, abs=4 * np.sqrt(2 / outputs))
    assert scores["innovation_correlation"].mean() == pytest.approx(0, abs=4 / np.sqrt(outputs))
    assert scores["coverage"].mean() == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize(
    ("process_noise", "sign"), [(PROCESS_NOISE / 3, 1), (4 * PROCESS_NOISE, -1)]
)
def test_one_that_is_told_wrong_is_not(gaussian, process_noise, sign):
    scores = scores_of(EKF(Linear(), NOISE, process_noise, assumed_noise=0.0), gaussian)
    low, high = band(BATCH, 2)
    anees = scores["anees"].mean()
    assert anees > high if sign > 0 else anees < low
    assert sign * (scores["nis"].mean() - 1) > 0.1
    assert sign * (0.9 - scores["coverage"].mean()) > 0.02
    assert sign * scores["innovation_correlation"].mean() > 0.05


def test_a_smoother_is_consistent_and_has_no_innovations(gaussian):
    scores = scores_of(RTSSmoother(Linear(), NOISE, PROCESS_NOISE, assumed_noise=0.0), gaussian)
    low, high = band(BATCH, 2)
    assert low < scores["anees"].mean() < high
    assert scores["nis"] is None
    assert scores["innovation_correlation"] is None


def test_estimators_without_a_covariance_have_no_scores(gaussian):
    x, record = gaussian
    scores = consistency(x, Estimates(x.copy()), np.isnan(record.y))
    assert set(scores.values()) == {None}


def test_hand_computed_case():
    x = np.zeros((2, 2, 2))
    xhat = np.array([[[1.0, 2.0], [3.0, 0.0]], [[1.0, 2.0], [np.nan, 0.0]]])
    P = np.broadcast_to(np.diag([1.0, 4.0]), (2, 2, 2, 2))
    innovation = np.array([[[1.0], [0.5]], [[2.0], [np.nan]]])
    S = np.full((2, 2, 1, 1), 4.0)
    missing = np.zeros((2, 2, 1), dtype=bool)
    scores = consistency(x, Estimates(xhat, P, innovation, S), missing)
    assert scores["anees"][0] == pytest.approx((1 + 1 + 9) / 4)
    assert scores["coverage"].tolist() == [0.75, 0.75]  # 3 is beyond 1.645, and so is nan
    assert scores["nis"][0] == pytest.approx((1 / 4 + 0.25 / 4) / 2)
    assert scores["innovation_correlation"][0] == pytest.approx(1)  # of a single pair
    for name in ("anees", "nis", "innovation_correlation"):
        assert np.isinf(scores[name][1])


def test_what_is_no_covariance_is_infinitely_wrong():
    x = np.zeros((3, 1, 2))
    P = np.stack([np.diag([1.0, -1.0]), np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]])])
    scores = consistency(x, Estimates(x + 0.1, P[:, None]), np.zeros((3, 1, 1), dtype=bool))
    assert np.isinf(scores["anees"]).all()


def test_the_band_is_the_textbook_one():
    # Tables of χ² with 100 degrees of freedom: 74.22 and 129.56 for the sum of 50 runs of 2 states.
    low, high = band(50, 2)
    assert (low * 100, high * 100) == pytest.approx((74.22, 129.56), abs=0.005)
    assert chi2.cdf(high * 100, 100) - chi2.cdf(low * 100, 100) == pytest.approx(0.95)


@pytest.mark.parametrize(
    ("kind", "options", "tolerance"),
    [
        (MHE, {"assumed_noise": 0.0, "window": 4}, {"rtol": 1e-6, "atol": 1e-9}),
        (ParticleFilter, {"particles": 20_000}, {"rtol": 0.15, "atol": 1e-3}),
    ],
)
def test_covariances_of_innovations_are_the_kalman_filters(gaussian, kind, options, tolerance):
    """Without process noise, which neither has within its window or at all."""
    record = gaussian[1].rows(slice(0, 5))
    record = replace(record, t=record.t[:8], y=record.y[:, :8], u=record.u[:, :8])
    expected = EKF(Linear(), NOISE, assumed_noise=0.0).run(record).S
    found = kind(Linear(), NOISE, **options).run(record).S
    np.testing.assert_allclose(found, expected, **tolerance)


def test_rows_have_them_where_they_apply():
    (row,) = evaluate("ekf", "pinnobs/Academic-v0", episodes=1)
    for name in ("anees", "coverage", "nis", "innovation_correlation", "reference_steady"):
        assert isinstance(row[name], float), name
    (row,) = evaluate("open_loop", "pinnobs/Academic-v0", episodes=1)
    assert row["anees"] is None
    assert row["nrmse_steady"] > row["reference_steady"]
