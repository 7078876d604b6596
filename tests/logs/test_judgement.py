"""What speaks against the estimates of a log."""

from dataclasses import replace

import numpy as np
import pytest
from linear import Linear, linear_record
from scipy.stats import binomtest, chi2

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.logs.judgement import _chance, _nis_ratios, doubts


def long_record(num_samples=200):
    """A record of zeros, and innovations and covariances of two correlated outputs as they are if
    the model is right."""
    rng = np.random.default_rng(0)
    S = np.array([[2.0, 0.9], [0.9, 0.7]])
    e = rng.multivariate_normal(np.zeros(2), S, num_samples)
    record = linear_record().rows(slice(0, 1))
    zeros = np.zeros((1, num_samples, 2))
    record = replace(record, t=0.1 * np.arange(num_samples), y=zeros, u=zeros[..., :0])
    whole = np.broadcast_to(S, (1, num_samples, 2, 2)).copy()
    return record, Estimates(zeros.copy(), innovation=e[None], S=whole)


def test_innovations_of_a_right_model_raise_no_doubt():
    record, estimates = long_record()
    assert doubts(Linear(), record, estimates) == []
    assert doubts(Linear(), linear_record(), EKF(Linear()).run(linear_record())) == []


@pytest.mark.parametrize(("factor", "says"), [(2.0, "too large"), (0.5, "too small")])
def test_innovations_that_their_covariances_do_not_explain_are_told(factor, says):
    record, estimates = long_record()
    wrong = replace(estimates, innovation=factor * estimates.innovation)
    (line,) = doubts(Linear(), record, wrong)
    assert says in line
    assert doubts(Linear(), record, replace(wrong, S=None)) == []
    few = replace(
        wrong, xhat=wrong.xhat[:, :8], innovation=wrong.innovation[:, :8], S=wrong.S[:, :8]
    )
    assert doubts(Linear(), record.first_samples(8), few) == []  # may be chance


def test_ratios_of_missing_outputs_are_those_of_the_others():
    record, estimates = long_record(40)
    y = record.y.copy()
    y[0, ::3, 0], y[0, ::4, 1] = np.nan, np.nan
    found = np.sort(_nis_ratios(replace(record, y=y), estimates))
    expected = []
    for k, row in enumerate(y[0]):
        kept = np.flatnonzero(~np.isnan(row))
        if len(kept):
            e, S = estimates.innovation[0, k, kept], estimates.S[0, k][np.ix_(kept, kept)]
            expected.append(e @ np.linalg.inv(S) @ e / chi2.median(len(kept)))
    np.testing.assert_allclose(found, np.sort(expected), rtol=1e-10)


@pytest.mark.parametrize("above", [0, 3, 10, 17])
def test_the_chance_is_that_of_the_sign_test(above):
    ratios = np.where(np.arange(20) < above, 2.0, 0.5)
    assert _chance(ratios) == pytest.approx(binomtest(above, 20).pvalue)


def test_estimates_far_away_or_not_finite_are_told():
    record, estimates = long_record()
    estimates.xhat[0, 7, 1] = -2e3
    (line,) = doubts(Linear(), record, estimates)
    assert line.startswith("x2 is estimated as -2000, 2e+03 times its scale away from the start")
    estimates.xhat[0, 8, 0] = np.inf
    assert doubts(Linear(), record, estimates) == ["the estimates leave the finite numbers"]
