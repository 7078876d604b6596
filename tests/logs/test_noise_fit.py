"""Noise, and parameters with it, of largest likelihood."""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from fitted_plants import Drift, Oscillator, Swing, log_of, simulated_log
from scipy.linalg import expm

from pinnobs_gym.logs.filter_rows import FilterRows
from pinnobs_gym.logs.fit import fit
from pinnobs_gym.logs.likelihood import minus_two_log_likelihoods
from pinnobs_gym.logs.noise_fit import _Likelihood, fit_noise
from pinnobs_gym.logs.unknown import unknown_parameters
from pinnobs_gym.simulation.kernels import plant_library

NONE = unknown_parameters(Oscillator(), ())
SETUP = Oscillator.setups["benchmark"]


def noisy_log(num_samples, seed=0):
    u = np.zeros((num_samples, 1))
    return simulated_log(Oscillator(measured_input=True), SETUP, num_samples, seed, u)[0]


def dense_cost(log, k, c, output_std, process_std):
    """−2 log p of all outputs of an oscillator at once: they are jointly Gaussian, with means and
    covariances from the matrix exponential (Van Loan 1978)."""
    t, y, prior = log.record.t, log.record.y[0, :, 0], log.record.prior
    A, n = np.array([[0, 1], [-k, -c]]), len(t)
    density, dt = np.diag([0, process_std**2]), t[1] - t[0]
    blocks = expm(dt * np.block([[-A, density], [np.zeros((2, 2)), A.T]]))
    F = blocks[2:, 2:].T
    Q = F @ blocks[:2, 2:]
    powers = np.array(list(accumulate([F] * (n - 1), np.dot, initial=np.eye(2))))[:, 0]
    mean, P = prior.mean[0], prior.cov[0]
    means, cov = np.empty(n), np.empty((n, n))
    for i in range(n):
        if i:
            mean, P = F @ mean, F @ P @ F.T + Q
        # The covariance of the state at i with those at i and later
        means[i], cov[i, i:] = mean[0], powers[: n - i] @ P[:, 0]
        cov[i:, i] = cov[i, i:]
    known = ~np.isnan(y)
    S = (cov + output_std**2 * np.eye(n))[np.ix_(known, known)]
    off = (y - means)[known]
    return off @ np.linalg.solve(S, off) + np.linalg.slogdet(2 * np.pi * S)[1]


def cost_as_told(log, setup):
    """−2 log p of a log with the told noise."""
    found = FilterRows([log], setup, NONE, False).run(log, np.zeros((1, 0)))
    return minus_two_log_likelihoods(log.record.y[0], *found)[0]


def test_the_likelihood_is_that_of_all_outputs_at_once():
    log = noisy_log(40)
    log.record.y[0, [3, 4, 20], 0] = np.nan
    expected = dense_cost(log, 4, 0.3, 0.1, 0.5)
    assert cost_as_told(log, SETUP) == pytest.approx(expected, rel=1e-5)


def test_the_fit_maximises_the_likelihood_of_all_outputs_at_once():
    """Parameters, output noise and process noise."""
    log = noisy_log(200, seed=3)
    told = replace(SETUP, noise_std=0.03, process_noise=(0.0, 2.0))
    made = fit([log], told, unknown_parameters(Oscillator(), ["k=3", "c=0.5"]), noise=True)
    found = np.array([each.value for each in made.found])

    def cost(v):
        return dense_cost(log, *v[:2], *np.exp(v[2:]))

    at, steps = np.r_[found[:2], np.log(found[2:])], 1e-2 * np.eye(4)
    gradient = np.array([cost(at + a) - cost(at - a) for a in steps]) / 2e-2
    hessian = np.empty((4, 4))
    for i, a in enumerate(steps):
        for j, b in enumerate(steps[: i + 1]):
            plus, minus = cost(at + a + b) + cost(at - a - b), cost(at + a - b) + cost(at - a + b)
            hessian[i, j] = hessian[j, i] = (plus - minus) / 4e-4
    # Newton's step from what was found is far below the standard errors, which are close to those
    # of the observed information.
    observed = np.sqrt(np.diag(np.linalg.inv(hessian / 2)))
    assert np.linalg.eigvalsh(hessian).min() > 0
    assert abs(np.linalg.solve(hessian, gradient) / observed).max() < 0.02
    errors = np.array([each.std for each in made.found]) / np.r_[1, 1, found[2:]]
    assert errors == pytest.approx(observed, rel=0.35)


def test_two_logs_tell_as_much_as_their_likelihoods_together():
    logs = [noisy_log(150, seed) for seed in (5, 6)]
    told = FilterRows(logs, SETUP, NONE, True)
    both = _Likelihood(told, NONE).costs(np.zeros((1, 2)))[0]
    assert both == pytest.approx(sum(cost_as_told(log, SETUP) for log in logs))
    alone = [fit([log], SETUP, NONE, noise=True).found[1].std for log in logs]
    assert fit(logs, SETUP, NONE, noise=True).found[1].std < min(alone)


def test_process_noise_that_is_none_is_said():
    silent = replace(SETUP, process_noise=0.0)
    log, _ = simulated_log(
        Oscillator(measured_input=True), silent, 400, 1, np.zeros((400, 1))
    )  # fmt: skip
    made = fit([log], SETUP, NONE, noise=True)
    assert any("do not tell the process noise from zero" in line for line in made.warnings)
    assert made.found[0].value == pytest.approx(0.1, abs=4 * made.found[0].std)


def test_process_noise_that_the_model_leaves_out_is_found_by_state():
    silent = replace(SETUP, process_noise=0.0)
    made = fit([noisy_log(3000)], silent, NONE, noise=True)
    by_name = {each.name: each for each in made.found}
    rate = by_name["process noise of v"]
    assert rate.value == pytest.approx(0.5, abs=4 * rate.std)
    assert rate.std < 0.1
    assert by_name["process noise of x"].value < 0.1
    assert any("the model tells no process noise" in line for line in made.warnings)


def test_noise_that_the_log_tells_by_sample_stands():
    log = noisy_log(200)
    std = np.full((200, 1), 0.1)
    log = log_of(log.system, SETUP, log.record.t, log.record.y[0], np.zeros((200, 1)), std)
    made = fit([log], replace(SETUP, noise_std=5.0), NONE, noise=True)
    assert [each.name for each in made.found] == ["process noise of v"]
    expected = dense_cost(log, 4, 0.3, 0.1, 0.5)
    assert cost_as_told(log, replace(SETUP, noise_std=5.0)) == pytest.approx(expected, rel=1e-4)


def test_parameters_of_a_plant_with_told_process_noise_are_those_of_largest_likelihood():
    log = noisy_log(800)
    made = fit([log], SETUP, unknown_parameters(Oscillator(), ["k=3", "c=0.5"]))
    assert made.method.startswith("maximum likelihood")
    for each, true in zip(made.found, (4.0, 0.3), strict=True):
        assert abs(each.value - true) < 4 * each.std


def test_nothing_is_compiled_between_evaluations(monkeypatch):
    made = []
    traced = plant_library._traced
    monkeypatch.setattr(plant_library, "_traced", lambda *a: made.append(a[1]) or traced(*a))
    fit([noisy_log(60)], SETUP, unknown_parameters(Oscillator(), ["k=3.5"]), noise=True)
    assert len(made) <= len(set(made))  # each algorithm once at most


def test_nothing_to_find_is_refused():
    with pytest.raises(ValueError, match="nothing is to be found"):
        fit([noisy_log(10)], SETUP, NONE)


def test_a_model_that_is_finite_nowhere_is_refused():
    setup = Swing.setups["benchmark"]
    log, _ = simulated_log(Swing(), setup, 30)
    with pytest.raises(ValueError, match="not finite"):
        fit([log], setup, unknown_parameters(Swing(), ["damping=-1e6"]))


def test_the_drift_of_a_point_of_known_noise():
    """With white output noise alone the likelihood gives the parameter of least squares."""
    setup = Drift.setups["benchmark"]
    log, _ = simulated_log(Drift(), setup, 60, seed=2)
    by_trajectory = fit([log], setup, unknown_parameters(Drift(), ["b=2"])).found[0]
    by_likelihood = fit_noise([log], setup, unknown_parameters(Drift(), ["b=2"]), noise=False)
    assert 2 + 2 * by_likelihood.unknowns[0] == pytest.approx(by_trajectory.value, rel=1e-5)


def test_outliers_that_decide_the_noise_are_told():
    """A right log has none; three of its outputs wrong by 50 standard deviations are told."""
    log = noisy_log(400, seed=5)
    assert not any("far beyond" in line for line in fit([log], SETUP, NONE, noise=True).warnings)
    log.record.y[0, [80, 190, 310], 0] += 5.0
    made = fit([log], SETUP, NONE, noise=True)
    assert made.found[0].value > 3 * 0.1
    (line,) = [line for line in made.warnings if "far beyond" in line]
    assert "% of y1" in line


def test_as_many_unknowns_as_outputs_are_refused():
    log = noisy_log(2)
    with pytest.raises(ValueError, match=r"2 output\(s\) in all; expected more than the 3 unknown"):
        fit([log], SETUP, unknown_parameters(Oscillator(), ["k"]), noise=True)
