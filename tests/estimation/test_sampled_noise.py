"""Output noise that a record gives by sample, against filters written out and equal levels."""

import re
from dataclasses import replace

import numpy as np
import pytest
from linear import H, Linear, linear_record, runge_kutta_matrix

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior, Record


class ByHand(Linear):
    """The linear plant with its Jacobians."""

    def f_jacobian(self, t, x, u):
        return np.broadcast_to([[0.0, 1.0], [-2.0, -0.3]], (*x.shape, 2))

    def h_jacobian(self, t, x, u):
        return np.broadcast_to(H, (*x.shape, 2))


LEVELS = np.random.default_rng(3).uniform(0.02, 0.5, (3, 20, 2))
CLASSICAL = [
    cls
    for cls in ESTIMATORS.classes().values()
    if not (cls.needs_training or cls.trains_on_record) and cls.__name__ != "SB3"
]


def filtered(record, levels):
    """The Kalman filter of the linear plant with these standard deviations at each sample."""
    F, found = runge_kutta_matrix(0.1), np.empty((*record.y.shape[:2], 2))
    for row in range(record.batch):
        xhat, P = record.prior.mean[row], record.prior.cov[row]
        for k in range(record.num_samples):
            if k:
                xhat, P = F @ xhat, F @ P @ F.T
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(levels[row, k] ** 2))
            xhat, P = xhat + K @ (record.y[row, k] - H @ xhat), P - K @ H @ P
            found[row, k] = xhat
    return found


def test_the_ekf_is_the_kalman_filter_with_these_levels():
    record = replace(linear_record(), noise_std=LEVELS)
    found = EKF(ByHand(), 0.1, assumed_noise=0.0).run(record)
    np.testing.assert_allclose(found.xhat, filtered(record, LEVELS), rtol=0, atol=1e-12)


def test_where_a_level_is_not_given_that_of_the_estimator_holds():
    levels = np.where(np.arange(20)[:, None] % 3 == 0, np.nan, LEVELS)
    record = replace(linear_record(), noise_std=levels)
    found = EKF(ByHand(), 0.25, assumed_noise=0.0).run(record)
    expected = filtered(record, np.where(np.isnan(levels), 0.25, levels))
    np.testing.assert_allclose(found.xhat, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("cls", CLASSICAL, ids=lambda cls: cls.__name__)
def test_equal_levels_are_the_common_level(cls: type[BaseEstimator]):
    record = linear_record()
    plain = cls(ByHand(), 0.1).run(record)
    sampled = cls(ByHand(), 0.3).run(replace(record, noise_std=np.full((3, 20, 2), 0.1)))
    np.testing.assert_allclose(sampled.xhat, plain.xhat, rtol=0, atol=1e-9)


@pytest.mark.parametrize("cls", CLASSICAL, ids=lambda cls: cls.__name__)
def test_a_row_with_its_levels_alone_and_in_a_batch(cls: type[BaseEstimator]):
    """Row 2 has a prior so wide that filters carry roots of its covariance."""
    plain = linear_record()
    wide = plain.prior.cov * np.array([1.0, 1.0, 1e12])[:, None, None]
    prior = Prior(plain.prior.mean, wide)
    record = replace(plain, noise_std=LEVELS, prior=prior)
    whole = cls(ByHand()).run(record).xhat
    for row in range(3):
        alone = cls(ByHand()).run(record.rows(slice(row, row + 1))).xhat
        np.testing.assert_array_equal(alone[0], whole[row])


def test_a_record_of_some_samples_keeps_their_levels():
    record = replace(linear_record(), noise_std=LEVELS)
    np.testing.assert_array_equal(record.first_samples(5).noise_std, LEVELS[:, :5])
    np.testing.assert_array_equal(record.samples(np.array([1, 4])).noise_std, LEVELS[:, [1, 4]])
    np.testing.assert_array_equal(record.rows(np.array([2])).noise_std, LEVELS[[2]])
    first = EKF(ByHand()).run(record.first_samples(5)).xhat
    np.testing.assert_array_equal(first, EKF(ByHand()).run(record).xhat[:, :5])


def test_a_surer_output_counts_for_more():
    """Particles in a static posterior follow the output whose level is small."""
    record = linear_record(1).first_samples(1)
    y = np.array([[[0.9, -1.9]]])  # x = (0.9, -0.95), and the prior mean is (0.3, -0.2)
    sure = np.array([[[0.02, 50.0]]])
    prior = record.prior
    found = ParticleFilter(ByHand(), particles=4000).run(
        Record(record.t, y, record.u, prior, noise_std=sure)
    )
    assert abs(found.xhat[0, 0, 0] - 0.9) < 0.02
    assert abs(found.xhat[0, 0, 1] + 0.2) < 0.2


def log(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    record = linear_record(1)
    return read_log(path, ByHand(), record.prior).record


def test_a_log_gives_levels_by_sample(tmp_path):
    record = log(tmp_path, "t,y1,y2,y2_std,note_std\n0,1,2,0.5,a\n0.1,1,2,,b\n0.2,1,2,2e-1,c\n")
    nan = np.nan
    assert record.noise_std is not None
    np.testing.assert_array_equal(record.noise_std[0], [[nan, 0.5], [nan, nan], [nan, 0.2]])
    assert log(tmp_path, "t,y1,y2\n0,1,2\n").noise_std is None


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("0", "line 3: y1_std='0'; expected a number above 0, or no value"),
        ("-0.1", "line 3: y1_std='-0.1'; expected a number above 0, or no value"),
        ("inf", "line 3: y1_std='inf' is not a finite number"),
        ("wide", "line 3: y1_std='wide' is not a finite number"),
    ],
)
def test_a_level_that_is_none_is_told_by_line_and_column(tmp_path, cell, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        log(tmp_path, f"t,y1,y2,y1_std\n0,1,2,0.5\n0.1,1,2,{cell}\n")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda std: std[:, :3], r"noise_std has shape \(3, 3, 2\); expected \(3, 20, ny\)"),
        (lambda std: np.where(std == std[1, 4, 0], 0.0, std), "noise_std1 of row 1 is 0.0 at sam"),
        (lambda std: np.where(std == std[1, 4, 1], np.inf, std), "noise_std2 of row 1 is inf"),
    ],
)
def test_levels_of_a_record_are_checked(change, message):
    with pytest.raises(ValueError, match=message):
        replace(linear_record(), noise_std=change(LEVELS))
    record = replace(linear_record(), noise_std=LEVELS[..., :1])
    with pytest.raises(ValueError, match=r"noise_std has 1 column\(s\) in the record; ByHand has"):
        EKF(ByHand()).run(record)


def test_levels_that_are_not_given_keep_the_correlation():
    """A column without any number tells nothing."""
    G = ((0.1, 0.0), (0.09, 0.03))
    record = linear_record()
    plain = EKF(ByHand(), G).run(record)
    empty = EKF(ByHand(), G).run(replace(record, noise_std=np.full(record.y.shape, np.nan)))
    np.testing.assert_allclose(empty.xhat, plain.xhat, rtol=0, atol=1e-12)
    np.testing.assert_allclose(empty.P, plain.P, rtol=0, atol=1e-12)
    told = np.broadcast_to(np.sqrt(np.sum(np.square(G), axis=1)), record.y.shape)
    same = EKF(ByHand(), G).run(replace(record, noise_std=told))
    np.testing.assert_allclose(same.xhat, plain.xhat, rtol=0, atol=1e-12)
