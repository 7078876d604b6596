"""The ensemble Kalman filter: its inflation, and ensembles of few members."""

from dataclasses import dataclass

import numpy as np
import pytest
from linear import Linear, linear_record

from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System


@dataclass(frozen=True)
class HalfSeen(System):
    """Two constants, of which the first is measured."""

    state_names = ("seen", "unseen")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((-1.0, -1.0), (1.0, 1.0), duration=500.0, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        return 0.0 * x

    def h(self, t, x, u):
        return x[..., :1]

    def h_jacobian(self, t, x, u):
        return np.array([[1.0, 0.0]]) + 0 * x[..., None, :]


def constant_record(samples, missing=False):
    t = np.arange(samples) * 0.1
    y = 0.5 + 0.1 * np.random.default_rng(0).standard_normal((1, samples, 1))
    y = np.full_like(y, np.nan) if missing else y
    return Record(t, y, np.zeros((1, samples, 0)), Prior(np.zeros((1, 2)), np.eye(2)[None]))


def test_an_unseen_constant_does_not_grow():
    """It had grown by 1.01 a sample, to 1e21 in 5,000 samples."""
    found = EnKF(HalfSeen(), assumed_noise=0.0).run(constant_record(2000))
    std = np.sqrt(np.einsum("kii->ki", found.P[0]))
    assert (abs(np.log(std[:, 1])) < np.log(2.5)).all()  # what the perturbed outputs do by chance
    assert abs(found.xhat[0, -1, 0] - 0.5) < 0.1


def test_without_outputs_nothing_is_inflated():
    found = EnKF(HalfSeen(), assumed_noise=0.0).run(constant_record(200, missing=True))
    np.testing.assert_allclose(found.P[0], np.broadcast_to(found.P[0, 0], (200, 2, 2)), rtol=1e-9)


def test_the_inflation_keeps_the_spread_of_what_is_measured():
    """Without it the variance of a constant is R/n after n samples. An analysis that takes less
    than a factor λ of the standard deviation takes nothing in the end: σ²/R ≤ λ² − 1."""
    record, inflation = constant_record(400), 1.05
    options = {"assumed_noise": 0.0, "members": 400}
    variance = {
        factor: EnKF(HalfSeen(), inflation=factor, **options).run(record).P[0, -1, 0, 0] / 0.1**2
        for factor in (1.0, inflation)
    }
    assert variance[1.0] == pytest.approx(1 / 401, rel=0.3)
    assert 10 / 400 < variance[inflation] < inflation**2 - 1


@pytest.mark.parametrize("members", [2, 3])
def test_a_few_members_are_an_ensemble_too(members):
    record = linear_record()
    found = EnKF(Linear(), members=members).run(record)
    assert np.isfinite(found.xhat).all()
    ranks = np.linalg.matrix_rank(found.P[:, -1], tol=1e-9)
    assert (ranks == min(members - 1, 2)).all()
