"""What no estimator may be given: each is refused in one line, by every estimator."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from kinds import untrained
from linear import Linear, fed_through, linear_record

from pinnobs_gym.estimation.estimator import Estimates, Estimator, OfflineEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.systems import SYSTEMS

with SYSTEMS.isolated():  # what is registered while tests are collected would stay
    RECORD = linear_record()
EVERY = [*untrained(), "pinn_obs"]
ONLINE = [n for n in untrained() if issubclass(ESTIMATORS.resolve(n), Estimator)]


def of(name, system=None):
    return ESTIMATORS.resolve(name).for_setup(system or Linear(), Linear.setups["benchmark"])


def refused(estimator, record):
    with pytest.raises(ValueError, match=r"expected|has") as caught:
        estimator.run(record)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", EVERY)
def test_a_record_with_other_columns_is_refused(name):
    for y in (RECORD.y[..., :1], np.repeat(RECORD.y, 2, axis=-1)):
        line = f"y has {y.shape[-1]} column(s) in the record; Linear has ny=2"
        assert refused(of(name), replace(RECORD, y=y)) == line
    u = np.zeros((*RECORD.y.shape[:2], 1))
    line = "u has 1 column(s) in the record; Linear has nu=0"
    assert refused(of(name), replace(RECORD, u=u)) == line
    system, driven = fed_through(RECORD, measured=True)
    line = "u has 0 column(s) in the record; FeedThrough has nu=1"
    assert refused(of(name, system), replace(driven, u=driven.u[..., :0])) == line
    prior = Prior(RECORD.prior.mean[:, :1], RECORD.prior.cov)
    line = "the prior's mean has shape (3, 1); Linear has nx=2, expected (3, 2)"
    assert refused(of(name), replace(RECORD, prior=prior)) == line
    prior = Prior(RECORD.prior.mean, RECORD.prior.cov[:, :1])
    line = "the prior's cov has shape (3, 1, 2); Linear has nx=2, expected (3, 2, 2)"
    assert refused(of(name), replace(RECORD, prior=prior)) == line


@pytest.mark.parametrize("name", ONLINE)
def test_a_sample_of_another_shape_is_refused(name):
    estimator = of(name)
    state = estimator.reset(RECORD.prior)
    y, u = RECORD.y[:, 0], RECORD.u[:, 0]
    for wrong in (y[0], y[:1], y[:, :1], y[..., None]):
        with pytest.raises(ValueError, match=r"expected|has") as caught:
            estimator.update(state, 0.0, wrong, u)
        line = f"y has shape {wrong.shape}; expected (batch, ny)=(3, 2) for Linear"
        assert str(caught.value) == line
    with pytest.raises(ValueError, match=r"^u has shape \(3, 1\); expected \(batch, nu\)=\(3, 0\)"):
        estimator.update(state, 0.0, y, y[:, :1])


def test_a_plug_in_is_guarded_without_doing_anything():
    @dataclass(frozen=True)
    class Mean(OfflineEstimator):
        def run(self, record):
            """Return the mean."""
            mean = record.y.mean(axis=(1, 2))[:, None, None]
            return Estimates(mean + np.zeros((*record.y.shape[:2], 2)))

    assert Mean.run.__doc__ == "Return the mean."
    assert Mean(Linear()).run(RECORD).xhat.shape == RECORD.y.shape
    assert "y has 1 column(s)" in refused(Mean(Linear()), replace(RECORD, y=RECORD.y[..., :1]))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"y": RECORD.y + 1j},
            "y holds values of type complex128, such as .*; expected real numbers",
        ),
        (
            {"y": RECORD.y.astype(str)},
            "y holds values of type <U32, such as .*; expected real numbers",
        ),
        ({"u": np.full((3, 20, 1), None)}, "u holds values of type object, such as None; expec.*"),
        (
            {"t": np.array(["a"] * 20)},
            "t holds values of type <U1, such as .*'a'.*; expected real num.*",
        ),
        (
            {"u": np.full((3, 20, 2), np.nan)},
            "u1 of row 0 is nan at sample 0; expected finite numbers",
        ),
    ],
)
def test_values_that_are_no_numbers_are_refused(changes, line):
    with pytest.raises(ValueError, match=f"^{line}$"):
        replace(RECORD, **changes)


def test_an_infinite_output_is_named():
    y = RECORD.y.copy()
    y[1, 4, 1] = -np.inf
    line = "^y2 of row 1 is -inf at sample 4; expected finite numbers, or NaN if missing$"
    with pytest.raises(ValueError, match=line):
        replace(RECORD, y=y)


@pytest.mark.parametrize("dtype", [np.float32, int, bool])
def test_other_real_types_are_taken_as_doubles(dtype):
    prior = Prior(np.ones((3, 2), dtype), np.broadcast_to(np.eye(2), (3, 2, 2)).astype(dtype))
    given = Record(np.arange(20), RECORD.y.round().astype(dtype), RECORD.u.astype(dtype), prior)
    arrays = (given.t, given.y, given.u, given.prior.mean, given.prior.cov)
    assert {array.dtype for array in arrays} == {np.dtype(float)}
    doubles = Record(*(array.astype(float) for array in arrays[:3]), given.prior)
    np.testing.assert_array_equal(EKF(Linear()).run(given).xhat, EKF(Linear()).run(doubles).xhat)
