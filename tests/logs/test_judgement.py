"""What is said of the estimates of a log, with innovations whose law is known."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear, linear_record

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.logs.judgement import judge
from pinnobs_gym.logs.normalised import normalised
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, stack

SETUP = Linear.setups["benchmark"]
COVARIANCE = np.array([[2.0, 0.9], [0.9, 0.7]])


def right(num_samples=400, seed=0):
    """A record of zeros, and innovations and covariances of two correlated outputs as they are if
    the model is right."""
    rng = np.random.default_rng(seed)
    e = rng.multivariate_normal(np.zeros(2), COVARIANCE, num_samples)
    record = linear_record().rows(slice(0, 1))
    zeros = np.zeros((1, num_samples, 2))
    record = replace(record, t=0.1 * np.arange(num_samples), y=zeros, u=zeros[..., :0])
    S = np.broadcast_to(COVARIANCE, (1, num_samples, 2, 2)).copy()
    return record, Estimates(zeros.copy(), innovation=e[None], S=S)


def warned(record, estimates, system=None):
    return judge(system or Linear(), SETUP, record, estimates).warnings


@pytest.mark.parametrize("num_samples", [3, 40, 400, 20_000])
def test_innovations_of_a_right_model_raise_no_warning(num_samples):
    for seed in range(20 if num_samples < 1000 else 3):
        assert warned(*right(num_samples, seed)) == ()


def test_a_long_log_of_a_nearly_right_model_raises_none():
    """Whatever its chance: variances 1.4 times as large as told, correlation 0.15."""
    record, estimates = right(20_000)
    e = estimates.innovation.copy()
    e[:, 1:] = np.sqrt(1.4) * (np.sqrt(1 - 0.15**2) * e[:, 1:] + 0.15 * e[:, :-1])
    judgement = judge(Linear(), SETUP, record, replace(estimates, innovation=e))
    assert "y1 1.4" in judgement.facts[0]
    assert judgement.warnings == ()


@pytest.mark.parametrize(("factor", "says"), [(2.0, "too large"), (0.5, "too small")])
def test_innovations_of_another_size_are_told(factor, says):
    record, estimates = right()
    wrong = replace(estimates, innovation=factor * estimates.innovation)
    (line,) = warned(record, wrong)
    assert says in line
    assert "--noise-std" in line
    assert {"y1", "y2"} <= set(line.split())
    few = replace(
        wrong, xhat=wrong.xhat[:, :8], innovation=wrong.innovation[:, :8], S=wrong.S[:, :8]
    )
    judgement = judge(Linear(), SETUP, record.first_samples(8), few)
    assert judgement.warnings == ()  # may be chance
    assert "too few samples" in judgement.facts[0]


def test_the_wrong_sensor_is_named():
    record, estimates = right()
    e = estimates.innovation.copy()
    e[..., 1] *= 5
    (line,) = warned(record, replace(estimates, innovation=e))
    assert line.startswith("y2 (squares 2")
    assert "y1" not in line


def test_a_wrong_correlation_of_outputs_is_told_of_all_together():
    record, estimates = right(2000)
    S = estimates.S.copy()
    S[..., 0, 1] = S[..., 1, 0] = -0.9
    (line,) = warned(record, replace(estimates, S=S))
    assert line.startswith("all outputs together (squares ")


def summed(estimates, kept):
    """Innovations that last: each is a part of the one before, and as large as before."""
    e = estimates.innovation.copy()
    for k in range(1, e.shape[1]):
        e[:, k] = kept * e[:, k - 1] + np.sqrt(1 - kept**2) * e[:, k]
    return replace(estimates, innovation=e)


def test_innovations_that_last_are_told_with_what_to_try():
    record, estimates = right()
    slow = summed(estimates, 0.7)
    (line,) = warned(record, slow)
    assert "about as large as expected, but one is like the next" in line
    assert "--process-noise" in line
    (line,) = warned(record, replace(slow, innovation=4 * slow.innovation))
    assert "the model does not explain the outputs" in line
    assert "pinnobs fit" in line
    (line,) = warned(record, replace(slow, innovation=0.3 * slow.innovation))
    assert "an error of the model" in line
    (line,) = warned(record, summed(estimates, -0.5))
    assert "the opposite of the one before" in line


def test_a_slow_part_is_told_where_neighbours_are_hardly_alike():
    record, estimates = right(4000)
    slow = summed(right(4000, 1)[1], 0.99).innovation
    e = np.sqrt(0.8) * estimates.innovation + np.sqrt(0.2) * slow
    (line,) = warned(record, replace(estimates, innovation=e))
    assert "means of " in line


def test_outliers_are_not_taken_for_a_wrong_noise():
    record, estimates = right()
    rng = np.random.default_rng(1)
    wrong = (rng.random((1, 400, 2)) < 0.05) * rng.standard_normal((1, 400, 2))
    e = estimates.innovation + 10 * np.sqrt(np.diag(COVARIANCE)) * wrong
    (line,) = warned(record, replace(estimates, innovation=e))
    assert "these are outliers" in line
    assert "robust_ekf" in line
    burst = estimates.innovation.copy()
    burst[:, 300:330] *= 12
    (line,) = warned(record, replace(estimates, innovation=burst))
    assert "come together" in line
    assert "the model fails" in line


def test_even_one_extreme_output_is_told():
    """A normal value beyond 20 standard deviations has a chance of 1e-88."""
    record, estimates = right()
    e = estimates.innovation.copy()
    e[0, 300, 0] = 9 * np.sqrt(2.0)
    assert warned(record, replace(estimates, innovation=e)) == ()
    e[0, 300, 0] = 50 * np.sqrt(2.0)
    (line,) = warned(record, replace(estimates, innovation=e))
    assert "the largest 50 standard deviations at t = 30): single outputs are far" in line


def test_the_start_does_not_count_but_its_first_sample_tells_the_prior():
    record, estimates = right()
    wrong = estimates.innovation.copy()
    wrong[:, :35] *= 30
    wrong[:, 0] = (12 * np.sqrt(2.0), 0.1)
    (line,) = warned(record, replace(estimates, innovation=wrong))
    assert line.startswith("the first y1 = 0 (12 times)")
    assert "--xhat0" in line
    # A wide prior: the start lasts until the covariances have settled.
    S = estimates.S * np.where(np.arange(400) < 120, 1e4, 1.0)[:, None, None]
    found = normalised(Linear(), SETUP, record, replace(estimates, S=S))
    assert found.start == 120


def test_squares_are_those_of_the_outputs_that_a_sample_has():
    record, estimates = right(40)
    y = record.y.copy()
    y[0, ::3, 0], y[0, ::4, 1] = np.nan, np.nan
    found = normalised(Linear(), SETUP, replace(record, y=y), estimates).squares
    for k, row in enumerate(y[0]):
        kept = np.flatnonzero(~np.isnan(row))
        e, S = estimates.innovation[0, k, kept], estimates.S[0, k][np.ix_(kept, kept)]
        expected = e @ np.linalg.inv(S) @ e if len(kept) else np.nan
        np.testing.assert_allclose(found[k], expected, rtol=1e-10)


def test_missing_outputs_steps_and_gaps_are_facts():
    record, estimates = right(100)
    y, t = record.y.copy(), record.t.copy()
    y[0, ::4, 1] = np.nan
    t[60:] += 7.25
    facts = "\n".join(judge(Linear(), SETUP, replace(record, t=t, y=y), estimates).facts)
    assert "outputs missing: y2 25 %" in facts
    assert "median 0.1 s, smallest 0.1, largest 7.35 after t = 5.9; the setup has 0.1 s" in facts


def test_covariances_that_are_none_are_left_out():
    record, estimates = right()
    S = estimates.S.copy()
    S[0, 100:200] = 0.0
    S[0, 200:210] = [[1.0, 2.0], [2.0, 1.0]]
    found = normalised(Linear(), SETUP, record, replace(estimates, S=S))
    assert np.isnan(found.squares[100:210]).all()
    assert np.isfinite(found.squares[210:]).all()
    assert warned(record, replace(estimates, S=S)) == ()


def test_slow_residuals_that_exceed_white_noise_are_told_of_few_samples():
    """Estimates at zero, without covariances, of outputs that walk with twice the noise."""
    walks = summed(right(300)[1], 0.99).innovation[0]
    y = 0.2 * walks / np.sqrt(np.mean(walks**2, axis=0))
    record = replace(right(300)[0], y=y[None])
    (line,) = warned(record, Estimates(np.zeros((1, 300, 2))))
    assert "estimates differ from the outputs by more than the noise" in line
    small = replace(record, y=record.y / 4)  # within the noise, as of a right model
    assert warned(small, Estimates(np.zeros((1, 300, 2)))) == ()


def test_estimates_far_away_or_not_finite_are_told():
    record, estimates = right(200)
    estimates.xhat[0, 7, 1] = -2e3
    (line,) = warned(record, estimates)
    assert line.startswith("x2 is estimated as -2000, 2e+03 times its scale away from the start")
    estimates.xhat[0, 8, 0] = np.inf
    assert warned(record, estimates) == ("the estimates leave the finite numbers at t = 0.8",)


def test_a_plant_that_goes_far_has_not_diverged():
    """The innovations fit, and the estimate is a thousand scales away, but known."""
    record, estimates = right(200)
    estimates.xhat[0, :, 1] = np.linspace(0, 5e3, 200)
    P = np.tile(np.eye(2), (1, 200, 1, 1))
    assert warned(record, replace(estimates, P=P)) == ()
    unsure = P * np.array([1.0, 1e8])[:, None]
    assert "probably diverged" in "\n".join(warned(record, replace(estimates, P=unsure)))
    wrong = replace(estimates, P=P, innovation=5 * estimates.innovation)
    assert "probably diverged" in warned(record, wrong)[0]


def test_a_noise_that_is_told_as_zero_is_no_noise_told_too_large():
    record, estimates = right()
    small = replace(estimates, innovation=0.1 * estimates.innovation)
    assert judge(Linear(), replace(SETUP, noise_std=0.0), record, small).warnings == ()
    assert warned(record, small)


def simulated(num_samples, noise_std, seed=0):
    """A record of the linear plant, by its exact solution, and its true states."""
    rng = np.random.default_rng(seed)
    from scipy.linalg import expm

    F = expm(0.1 * np.array([[0.0, 1.0], [-2.0, -0.3]]))
    x = np.empty((num_samples, 2))
    x[0] = np.array([0.3, -0.2]) + np.array([0.8, 0.5]) * rng.standard_normal(2)
    for k in range(1, num_samples):
        x[k] = F @ x[k - 1]
    y = x * [1.0, 2.0] + noise_std * rng.standard_normal((num_samples, 2))
    t = 0.1 * np.arange(num_samples)
    return Record(t, y[None], np.zeros((1, num_samples, 0)), Prior.of(Linear(), SETUP, 1))


@pytest.mark.parametrize("cls", [EKF, RTSSmoother, BatchLeastSquares, Luenberger])
def test_a_right_log_of_a_plant_raises_no_warning(cls):
    record = simulated(300, 0.1)
    judgement = judge(Linear(), SETUP, record, cls(Linear()).run(record))
    assert judgement.warnings == ()
    assert len(judgement.facts) >= 4


@pytest.mark.parametrize("cls", [RTSSmoother, BatchLeastSquares, Luenberger])
def test_residuals_beyond_the_noise_are_told(cls):
    record = simulated(300, 0.5)
    (line,) = judge(Linear(), SETUP, record, cls(Linear()).run(record)).warnings
    assert "estimates differ from the outputs by more than the noise" in line


def test_small_residuals_speak_against_the_noise_only_with_small_covariances():
    """A batch fit of 300 samples has followed no noise; a Luenberger observer may have."""
    record = simulated(300, 0.01)
    (line,) = judge(Linear(), SETUP, record, BatchLeastSquares(Linear()).run(record)).warnings
    assert "residuals are too small" in line
    assert judge(Linear(), SETUP, record, Luenberger(Linear()).run(record)).warnings == ()


def test_residuals_have_the_variance_of_the_noise_less_that_of_the_estimate():
    """R − HPHᵀ for an optimal estimate, here of a constant plant by the mean of few samples."""
    variances = []
    for seed in range(200):
        record = simulated(12, 0.1, seed)
        estimates = BatchLeastSquares(Linear()).run(record)
        found = normalised(Linear(), SETUP, record, estimates)
        variances.append(np.nanmean(found.values**2))
    assert np.mean(variances) == pytest.approx(1.0, abs=0.06)


@dataclass(frozen=True)
class Parts(System):
    """A position whose speed is measured, a constant that nothing sees, and a level that process
    noise drives from a narrow prior, measured."""

    state_names = ("position", "speed", "constant", "level")
    output_names = ("speed", "level")
    scale = (1.0, 1.0, 1.0, 1.0)
    setups = {
        "benchmark": Setup(
            xhat0=(0.0, 0.0, 0.0, 0.0),
            P0=independent(0.5, 1.0, 0.3, 1e-3),
            dt=0.1,
            noise_std=0.1,
            process_noise=(0.0, 0.1, 0.0, 0.3),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -x[..., 1], 0.0, 0.0)

    def h(self, t, x, u):
        return stack(x, x[..., 1], x[..., 3])


def test_states_that_no_output_sees_are_told_and_others_not():
    system, setup = Parts(), Parts.setups["benchmark"]
    rng = np.random.default_rng(0)
    level = np.cumsum(0.3 * np.sqrt(0.1) * rng.standard_normal(200))
    speed = np.empty(200)
    speed[0] = 0.5
    for k in range(1, 200):
        speed[k] = np.exp(-0.1) * speed[k - 1] + 0.1 * np.sqrt(0.09) * rng.standard_normal()
    y = np.stack([speed, level], axis=1) + 0.1 * rng.standard_normal((200, 2))
    t = 0.1 * np.arange(200)
    record = Record(t, y[None], np.zeros((1, 200, 0)), Prior.of(system, setup, 1))
    for cls in (EKF, RTSSmoother):
        estimates = cls.for_setup(system, setup).run(record)
        judgement = judge(system, setup, record, estimates)
        assert "states that the outputs tell nothing of: position, constant" in judgement.facts
        (line,) = judgement.warnings
        assert line.startswith("position, constant: ")
    # A constant that is well known needs no output; the position grows uncertain with the speed.
    known = replace(setup, P0=independent(0.01, 1.0, 0.01, 1e-3))
    record = replace(record, prior=Prior.of(system, known, 1))
    judgement = judge(system, known, record, EKF.for_setup(system, known).run(record))
    assert "states that the outputs tell nothing of: position, constant" in judgement.facts
    (line,) = judgement.warnings
    assert line.startswith("position: ")


def test_a_filter_that_has_to_find_the_state_first_is_a_fact_and_no_warning():
    record, estimates = right(1000)
    e, slow = estimates.innovation.copy(), summed(right(1000, 1)[1], 0.9).innovation
    e[:, :300] = 3 * slow[:, :300]
    judgement = judge(Linear(), SETUP, record, replace(estimates, innovation=e))
    assert judgement.warnings == ()
    assert "the filter had to find the state first" in "\n".join(judgement.facts)
    late = estimates.innovation.copy()
    late[:, 700:] = 3 * slow[:, 700:]
    assert warned(record, replace(estimates, innovation=late))
