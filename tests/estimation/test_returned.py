"""What estimators of users return: arrays of other shapes or types are refused, not broadcast."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from linear import Linear, linear_record

from pinnobs_gym.estimation.estimator import Estimates, Estimator, OfflineEstimator, State
from pinnobs_gym.systems import SYSTEMS

with SYSTEMS.isolated():  # what is registered while tests are collected would stay
    RECORD = linear_record()
BATCH, NUM_SAMPLES, NX = len(RECORD.y), RECORD.num_samples, 2


@dataclass(frozen=True)
class Late(Estimator):
    """Returns the prior, and from the fourth sample on other values of some fields."""

    changes: Any = None

    def reset(self, prior):
        innovation = np.zeros((len(prior.mean), 2))
        return State(prior.mean, None, None, prior.cov, innovation, prior.cov)

    def update(self, state, t, y, u):
        after = replace(state, t=t, u=u)
        return replace(after, **self.changes) if t > 0.25 and self.changes else after


@dataclass(frozen=True)
class Whole(OfflineEstimator):
    """Returns the prior at all samples, and other values of some fields."""

    changes: Any = None

    def run(self, record):
        xhat = np.repeat(record.prior.mean[:, None], record.num_samples, axis=1)
        return replace(Estimates(xhat), **(self.changes or {}))


WRONG = [
    ({"xhat": np.zeros((1, 2))}, ValueError, "xhat of shape (1, 2); expected (batch, nx)=(3, 2)"),
    ({"xhat": np.zeros(2)}, ValueError, "xhat of shape (2,); expected (batch, nx)=(3, 2)"),
    ({"xhat": [[0.5]]}, ValueError, "xhat of shape (1, 1); expected (batch, nx)=(3, 2)"),
    ({"xhat": 0.5}, ValueError, "xhat of shape (); expected (batch, nx)=(3, 2)"),
    ({"xhat": [[0.5], [1.0, 2.0]]}, TypeError, "a xhat that is no array; expected (batch, nx)=(3,"),
    (
        {"xhat": np.zeros((3, 2), complex)},
        TypeError,
        "numbers of type complex128 as xhat; expected",
    ),
    ({"xhat": np.full((3, 2), "0.5")}, TypeError, "numbers of type <U3 as xhat; exp"),
    ({"xhat": np.full((3, 2), None)}, TypeError, "numbers of type object as xhat; exp"),
    ({"xhat": None}, TypeError, "None as xhat; expected (batch, nx)=(3, 2), real numbers"),
    ({"P": np.eye(2)}, ValueError, "P of shape (2, 2); expected (batch, nx, nx)=(3, 2, 2)"),
    ({"P": None}, ValueError, "None as P, unlike at the sample before"),
    (
        {"innovation": np.zeros((3, 1))},
        ValueError,
        "innovation of shape (3, 1); expected (batch, n",
    ),
    ({"S": np.ones((3, 1, 1))}, ValueError, "S of shape (3, 1, 1); expected (batch, ny, ny)=(3, 2"),
    ({"outside": np.ones(3)}, ValueError, "an array as outside, unlike at the sample before"),
]


@pytest.mark.parametrize(("changes", "kind", "line"), WRONG)
def test_a_later_sample_with_a_field_of_another_kind_is_refused(changes, kind, line):
    with pytest.raises(kind) as caught:
        Late(Linear(), changes=changes).run(RECORD)
    assert str(caught.value).startswith(f"Late.update, at t=0.3 s, returned {line}")
    assert "\n" not in str(caught.value)


def test_a_live_update_is_checked_the_same():
    estimator = Late(Linear(), changes={"xhat": np.zeros((1, 2))})
    state = estimator.update(estimator.reset(RECORD.prior), 0.0, RECORD.y[:, 0], RECORD.u[:, 0])
    with pytest.raises(ValueError, match=r"^Late\.update, at t=1 s, returned xhat of shape \(1, 2"):
        estimator.update(state, 1.0, RECORD.y[:, 1], RECORD.u[:, 1])


def test_what_appears_later_is_refused():
    estimator = Late(Linear(), changes={"P": RECORD.prior.cov})
    state = replace(estimator.reset(RECORD.prior), P=None, t=0.2)
    with pytest.raises(ValueError, match="returned an array as P, unlike at the sample before"):
        estimator.update(state, 0.3, RECORD.y[:, 3], RECORD.u[:, 3])


def test_real_numbers_of_other_types_are_taken():
    exact = Late(Linear(), changes={"xhat": np.ones((BATCH, NX))}).run(RECORD).xhat
    for ones in (np.ones((BATCH, NX), np.float32), np.ones((BATCH, NX), int), [[1, 1]] * BATCH):
        xhat = Late(Linear(), changes={"xhat": ones}).run(RECORD).xhat
        assert xhat.dtype == float
        np.testing.assert_array_equal(xhat, exact)
        whole = Whole(Linear(), changes={"xhat": np.full((BATCH, NUM_SAMPLES, NX), ones[0][0])})
        assert whole.run(RECORD).xhat.dtype == float


@pytest.mark.parametrize(
    ("changes", "kind", "line"),
    [
        ({"xhat": np.zeros((1, 21, 2))}, ValueError, "xhat of shape (1, 21, 2); expected (batch, "),
        ({"P": np.eye(2)}, ValueError, "P of shape (2, 2); expected (batch, num_samples, nx, nx)="),
        ({"xhat": np.zeros((3, 21, 2)) * 1j}, TypeError, "numbers of type complex128 as xhat; exp"),
    ],
)
def test_estimates_of_whole_records_are_checked(changes, kind, line):
    with pytest.raises(kind) as caught:
        Whole(Linear(), changes=changes).run(RECORD)
    assert str(caught.value).startswith(f"Whole.run returned {line}")
