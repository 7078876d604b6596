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
from pinnobs_gym.systems.induction_motor import InductionMotor

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


WRONG = (
    ({"t": 0.5}, "t must increase; a sample has t=0.5 after 0.5"),
    ({"t": 0.25}, "t must increase; a sample has t=0.25 after 0.5"),
    ({"t": np.nan}, "t must be finite; a sample has t=nan"),
    ({"t": np.inf}, "t must be finite; a sample has t=inf"),
    ({"t": "1.0"}, "t holds values of type <U3, such as .*; expected real numbers"),
    ({"t": np.array([1.0])}, r"t has shape \(1,\); expected one number for all rows"),
    ({"y": np.array([[0, 0], [0, np.inf], [0, 0.0]])}, "y2 of row 1 is inf at t=1.0; expected .*"),
    ({"y": np.zeros((3, 2)) + 1j}, "y holds values of type complex128, such as .*"),
    ({"u": np.array([[0.5], [np.nan], [0.5]])}, "u1 of row 1 is nan at t=1.0; expected finite .*"),
    ({"u": np.array([[0.5], [0.5], [-np.inf]])}, "u1 of row 2 is -inf at t=1.0; expected .*"),
)


@pytest.mark.parametrize("name", ONLINE)
def test_a_sample_that_no_record_has_is_refused(name):
    """By `update`, which does not move for any of them; huge and missing outputs are taken."""
    system, driven = fed_through(RECORD, measured=True)
    estimator = of(name, system)
    state = estimator.update(estimator.reset(driven.prior), 0.5, driven.y[:, 0], driven.u[:, 0])
    given = {"t": 1.0, "y": driven.y[:, 1], "u": np.full((3, 1), 0.5)}
    for changes, line in WRONG:
        with pytest.raises(ValueError, match=f"^{line}$") as caught:
            estimator.update(state, **{**given, **changes})
        assert "\n" not in str(caught.value)
    for y in (np.full((3, 2), np.nan), np.full((3, 2), 1e200)):
        with np.errstate(all="ignore"):
            assert estimator.update(state, **{**given, "y": y}).t == 1.0


def test_the_first_sample_of_a_wrong_time_is_refused():
    state = EKF(Linear()).reset(RECORD.prior)
    for t in (np.nan, -np.inf):
        with pytest.raises(ValueError, match=f"^t must be finite; a sample has t={t}$"):
            EKF(Linear()).update(state, t, RECORD.y[:, 0], RECORD.u[:, 0])


@pytest.mark.parametrize("name", ONLINE)
def test_inputs_that_the_model_would_not_use_are_refused(name):
    """As of a record, whatever the sample; single precision is near enough, also beside zero."""
    with SYSTEMS.isolated():
        system, setup = InductionMotor.configured()
    estimator = ESTIMATORS.resolve(name).for_setup(system, setup)
    state = estimator.reset(Prior.of(system, setup, 1))
    for t in (0.0, np.pi / 60):  # there the second input, and then the first is zero
        u = system.input(np.array([t])).astype(np.float32)
        state = estimator.update(state, t, np.zeros((1, 2)), u)
    u = u + np.array([[0.0, 1.0]])
    with pytest.raises(ValueError, match=r"is not that of InductionMotor.input, .*; expected the"):
        estimator.update(state, 0.1, np.zeros((1, 2)), u)
    record = Record(
        np.array([np.pi / 60]), np.zeros((1, 1, 2)), u[None], Prior.of(system, setup, 1)
    )
    with pytest.raises(ValueError, match=r"^input .*is not that of InductionMotor.input, .*"):
        estimator.run(record)


def test_a_map_takes_no_sample_between_its_steps():
    @dataclass(frozen=True)
    class Steps(Linear):
        discrete = True
        setups = {"benchmark": replace(Linear.setups["benchmark"], dt=1.0)}

    estimator = EKF(Steps())
    state = estimator.update(estimator.reset(RECORD.prior), 0.0, RECORD.y[:, 0], RECORD.u[:, 0])
    line = "^a sample has t=0.5; Steps is a map, expected whole numbers$"
    with pytest.raises(ValueError, match=line):
        estimator.update(state, 0.5, RECORD.y[:, 0], RECORD.u[:, 0])
    with pytest.raises(ValueError, match=line):
        estimator.run(replace(RECORD, t=RECORD.t * 0 + np.arange(len(RECORD.t)) / 2))


@pytest.mark.parametrize("name", ONLINE)
def test_a_prior_that_is_none_is_refused(name):
    with pytest.raises(ValueError, match=r"^the prior's mean has shape \(3, 1\); Linear has nx=2"):
        of(name).reset(Prior(RECORD.prior.mean[:, :1], RECORD.prior.cov))
    for wrong in (np.nan, np.inf):
        with pytest.raises(ValueError, match=f"^the prior's mean has the entry {wrong}; expected"):
            Prior(RECORD.prior.mean + wrong, RECORD.prior.cov)
        with pytest.raises(ValueError, match=f"^the prior's cov has the entry {wrong}; expected"):
            Prior(RECORD.prior.mean, RECORD.prior.cov + wrong)


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


@pytest.mark.parametrize("name", ONLINE)
@pytest.mark.parametrize("dtype", ["list", np.float32, int])
def test_samples_like_arrays_are_taken_as_doubles(name, dtype):
    y = np.array([[1.0, -2.0], [0.0, 3.0]])
    given = y.tolist() if dtype == "list" else y.astype(dtype)
    estimator = ESTIMATORS.resolve(name)(Linear())
    start = estimator.reset(Prior(np.zeros((2, 2)), np.broadcast_to(np.eye(2), (2, 2, 2)).copy()))
    u = np.zeros((2, 0))
    found = estimator.update(start, 0.0, given, u.tolist() if dtype == "list" else u)
    expected = estimator.update(start, 0.0, y, u)
    np.testing.assert_array_equal(found.xhat, expected.xhat)
