"""An estimator in two steps."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from kinds import untrained
from linear import H, Linear, linear_record, runge_kutta_matrix

from pinnobs_gym.estimation.checks import check_estimator
from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.model import model_step

RECURSIVE = [n for n in untrained() if issubclass(ESTIMATORS.resolve(n), RecursiveEstimator)]
L = np.array([[0.4, 0.1], [-0.2, 0.3]])


@dataclass(frozen=True)
class ConstantGain(RecursiveEstimator):
    """x̂ = x̂⁻ + L(y − h), of which a missing output is left out."""

    exempt_from: ClassVar = {"units": "its gain is in one unit"}

    def reset(self, prior):
        return State(prior.mean)

    def predict(self, state, t, u):
        xhat = model_step(self.system, state.t, t, state.xhat, state.u, u)
        return State(xhat, state.t, state.u)

    def correct(self, state, t, y, u):
        innovation = np.where(np.isnan(y), 0.0, y - self.system.h(t, state.xhat, u))
        return State(state.xhat + innovation @ L.T, t, u)


def test_the_first_sample_corrects_the_prior_and_each_other_a_prediction():
    record = linear_record()
    record.y[1, 3] = np.nan
    F, xhat, expected = runge_kutta_matrix(0.1), record.prior.mean, []
    for k in range(record.num_samples):
        if k:
            xhat = xhat @ F.T
        xhat = xhat + np.nan_to_num(record.y[:, k] - xhat @ H.T) @ L.T
        expected.append(xhat)
    found = ConstantGain(Linear()).run(record).xhat
    np.testing.assert_allclose(found, np.stack(expected, axis=1), rtol=1e-12)


def test_an_update_of_its_own_is_refused():
    with pytest.raises(TypeError, match=r"^Own defines update; expected predict and correct, or"):

        class Own(ConstantGain):
            def update(self, state, t, y, u):
                return state

    class Mixin:
        def update(self, state, t, y, u):
            return state

    with pytest.raises(TypeError, match=r"^Mixed defines update; expected predict and correct"):
        type("Mixed", (Mixin, ConstantGain), {})


@pytest.mark.parametrize("method", ["predict", "correct"])
@pytest.mark.parametrize("value", [None, np.zeros((1, 2))], ids=["nothing", "array"])
def test_a_step_that_returns_no_state_is_named(method, value):
    wrong = type("Wrong", (ConstantGain,), {method: lambda self, *args: value})
    kind = type(value).__name__
    with pytest.raises(TypeError, match=rf"^Wrong\.{method} returned {kind}; expected a State$"):
        wrong(Linear()).run(linear_record())


def test_it_conforms():
    check_estimator(ConstantGain(Linear()))


@pytest.mark.parametrize("name", RECURSIVE)
def test_a_prediction_is_that_of_the_sample_to_come(name):
    """Without outputs the correction changes nothing, so that it shows the prediction."""
    estimator = ESTIMATORS.resolve(name).for_setup(Linear(), Linear.setups["benchmark"])
    record = linear_record()
    u, missing = record.u, np.full_like(record.y, np.nan)
    state = estimator.update(estimator.reset(record.prior), 0.0, record.y[:, 0], u[:, 0])
    predicted = estimator.predict(state, 0.1, u[:, 1])
    corrected = estimator.correct(predicted, 0.1, missing[:, 1], u[:, 1])
    np.testing.assert_allclose(predicted.xhat, corrected.xhat, atol=1e-12)
    assert predicted.t == state.t
