"""Parameters by least squares over the trajectory."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fitted_plants import (
    Decay,
    Drift,
    MapDecay,
    Oscillator,
    OwnDecay,
    StiffDecay,
    Swing,
    log_of,
    simulated_log,
)
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from pinnobs_gym.logs.fit import fit
from pinnobs_gym.logs.unknown import unknown_parameters

SILENT = replace(Oscillator.setups["benchmark"], process_noise=0.0)


def test_the_fit_of_a_linear_model_solves_the_normal_equations():
    """y = x₀ + bt with blank samples, noise by sample, and two logs with initial states of their
    own: ordinary weighted least squares, with the prior of x₀ as two more outputs."""
    setup, rng = Drift.setups["benchmark"], np.random.default_rng(1)
    logs, rows, right = [], [], []
    for i, n in enumerate((30, 17)):
        t, std = np.cumsum(rng.uniform(0.05, 0.2, n)), rng.uniform(0.1, 0.4, n)
        y = (1 - i) + 0.7 * t + std * rng.standard_normal(n)
        y[rng.random(n) < 0.2] = np.nan
        told = np.where(rng.random(n) < 0.3, np.nan, std)  # elsewhere that of the setup holds
        logs.append(log_of(Drift(), setup, t, y[:, None], noise_std=told[:, None]))
        sigma, known = np.where(np.isnan(told), 0.2, told), ~np.isnan(y)
        row = np.zeros((n, 3))
        row[:, i], row[:, 2] = 1, t - t[0]
        rows += [(row / sigma[:, None])[known], np.eye(3)[i : i + 1] / 2.0]
        right += [(y / sigma)[known], np.array([0.5 / 2.0])]
    A, b = np.concatenate(rows), np.concatenate(right)
    expected, cov = np.linalg.lstsq(A, b)[0], np.linalg.inv(A.T @ A)
    made = fit(logs, setup, unknown_parameters(Drift(), ["b=3"]))
    assert made.found[0].value == pytest.approx(expected[2], rel=1e-8)
    off = b - A @ expected
    first = len(rows[0])
    outputs = np.delete(np.arange(len(b)), [first, len(b) - 1])  # all but the priors
    # An initial state takes as much of the freedom as the outputs tell of it.
    inner = A[outputs][:, :2].T @ A[outputs][:, :2]
    taken = np.trace(np.linalg.solve(inner + np.eye(2) / 4.0, inner)) + 1
    excess = (off[outputs] ** 2).sum() / (len(outputs) - taken)
    assert made.found[0].std == pytest.approx(np.sqrt(cov[2, 2] * max(1, excess)), rel=1e-6)


def test_standard_errors_grow_with_residuals_beyond_the_told_noise():
    setup = Drift.setups["benchmark"]
    t = np.arange(2000) * 0.1
    y = (0.3 * t + np.random.default_rng(0).standard_normal(2000))[:, None]
    small = fit(
        [log_of(Drift(), replace(setup, noise_std=0.1), t, y)],
        replace(setup, noise_std=0.1),
        unknown_parameters(Drift(), ["b"]),
    )
    right = fit(
        [log_of(Drift(), setup, t, y)], replace(setup, noise_std=1.0),
        unknown_parameters(Drift(), ["b"]),
    )  # fmt: skip
    assert small.found[0].std == pytest.approx(right.found[0].std, rel=0.1)
    assert any("does not explain" in line for line in small.warnings)
    assert not right.warnings


def test_the_fit_of_a_driven_oscillator_is_that_of_scipy():
    """The same cost minimised by SciPy, over trajectories of SciPy's solver."""
    u = np.sign(np.sin(np.arange(120) * 0.21))[:, None]
    plant = Oscillator(measured_input=True)
    log, _ = simulated_log(plant, SILENT, 120, measured_input=u)
    y, t, prior = log.record.y[0, :, 0], log.record.t, log.record.prior

    def off(v):
        x, path = v[:2], [v[:2]]
        for k in range(len(t) - 1):

            def rate(_, x, force=u[k, 0]):
                return [x[1], force - v[2] * x[0] - v[3] * x[1]]

            x = solve_ivp(rate, t[k : k + 2], x, rtol=1e-9, atol=1e-11).y[:, -1]
            path.append(x)
        return np.r_[(np.array(path)[:, 0] - y) / 0.1, v[:2] - prior.mean[0]]

    peer = least_squares(off, [0.5, 0.0, 3.9, 0.25], x_scale=[1, 1, 4, 0.3], xtol=1e-10)
    errors = np.sqrt(np.diag(np.linalg.inv(peer.jac.T @ peer.jac)))[2:]
    made = fit([log], SILENT, unknown_parameters(plant, ["k=2.5", "c=1"]))
    found = np.array([each.value for each in made.found])
    assert abs(found - peer.x[2:]) == pytest.approx(0, abs=1e-3 * errors.min())
    enlarged = max(1, np.sqrt((peer.fun[:-2] ** 2).sum() / (len(y) - 4)))
    assert [each.std for each in made.found] == pytest.approx(errors * enlarged, rel=0.01)


@pytest.mark.parametrize("start", [4.0, 8.0, 16.0])
def test_a_frequency_is_found_from_afar_over_many_turns(start):
    """With 30 oscillations in the log, the cost has a minimum for each cycle that is slipped."""
    setup = Swing.setups["benchmark"]
    log, _ = simulated_log(Swing(), setup, 1300)
    log.record.y[...] = np.mod(log.record.y, 2 * np.pi)  # angles wrapped elsewhere
    made = fit([log], setup, unknown_parameters(Swing(), [f"a={start / 2}", "damping=0.3"]))
    for each, truth in zip(made.found, (4.0, 0.1), strict=True):
        assert abs(each.value - truth) < 4 * each.std < 0.05 * truth
    assert not made.warnings


def test_what_the_log_does_not_tell_is_said():
    setup = Swing.setups["benchmark"]
    log, _ = simulated_log(Swing(), setup, 200)
    made = fit([log], setup, unknown_parameters(Swing(), ["a=4.1", "b", "damping", "spare"]))
    by_name = {each.name: each.std for each in made.found}
    assert np.isfinite(by_name["damping"])
    assert np.isinf([by_name[name] for name in ("a", "b", "spare")]).all()
    assert any("not determined" in line and "a, b, spare" in line for line in made.warnings)


def test_a_parameter_stays_within_its_bounds():
    setup = Swing.setups["benchmark"]
    log, _ = simulated_log(Swing(), setup, 300)
    made = fit([log], setup, unknown_parameters(Swing(), ["a=3,1,3.5", "damping=0.2,0,inf"]))
    assert made.found[0].value == 3.5
    assert np.isnan(made.found[0].std)
    assert any("a is at its bound, 3.5" in line for line in made.warnings)


def test_residuals_of_a_wrong_model_are_told():
    """The force that the model does not know makes slow residuals."""
    u = 3 * np.sign(np.sin(np.arange(400) * 0.05))[:, None]
    log, _ = simulated_log(Oscillator(measured_input=True), SILENT, 400, measured_input=u)
    blind = log_of(Oscillator(), SILENT, log.record.t, log.record.y[0], 0 * u)
    made = fit([blind], SILENT, unknown_parameters(Oscillator(), ["c"]))
    assert any("does not explain the log" in line for line in made.warnings)
    assert any("correlated" in line for line in made.warnings)


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["q"], "unknown parameter 'q' of Swing; it has a, b, damping, spare, colour"),
        (["colour"], "colour='red' of Swing; expected a number"),
        (["a", "a=2"], "'a' is given twice"),
        (["a=x"], "parameter 'a=x'; expected name"),
        (["a=nan"], "parameter 'a=nan'; expected name"),
        (["a=inf"], "expected a finite start"),
        (["a=1,2,3"], "LOW <= START <= HIGH"),
        (["a=1,2"], "LOW <= START <= HIGH"),
    ],
)
def test_a_wrong_parameter_is_refused_in_one_line(texts, said):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        unknown_parameters(Swing(), texts)
    assert "\n" not in str(error.value)


def test_too_few_outputs_are_refused():
    setup = Drift.setups["benchmark"]
    log = log_of(Drift(), setup, np.arange(3) * 0.1, np.array([[1.0], [np.nan], [np.nan]]))
    with pytest.raises(ValueError, match=r"1 output\(s\) in all; expected more than the 1"):
        fit([log], setup, unknown_parameters(Drift(), ["b"]))


@pytest.mark.parametrize("plant", [Decay, StiffDecay, OwnDecay, MapDecay])
def test_every_motion_of_a_plant(plant):
    """Exact outputs of x' = -kx + u, or of the same map, with blank samples."""
    setup, n = plant.setups["benchmark"], 60
    t = setup.dt * np.arange(n)
    u = np.where(np.arange(n) % 20 < 10, 1.0, 0.0)[:, None]
    x = np.full((n, 1), 2.0)
    for i in range(1, n):
        held = u[i - 1]
        x[i] = (
            0.7 * x[i - 1] + held if plant.discrete
            else held / 0.7 + (x[i - 1] - held / 0.7) * np.exp(-0.7 * setup.dt)
        )  # fmt: skip
    x[[3, 30]] = np.nan
    log = log_of(plant(measured_input=True), setup, t, x, u)
    made = fit([log], setup, unknown_parameters(log.system, ["k=0.9"]))
    # The prior of the initial state, 2.1, draws it by the share of one output among many.
    assert made.found[0].value == pytest.approx(0.7, abs=3e-4)
    assert not [line for line in made.warnings if "correlated" not in line and "large" not in line]


def test_logs_of_two_systems_are_refused():
    first, _ = simulated_log(Swing(), Swing.setups["benchmark"], 20)
    second, _ = simulated_log(Drift(), Drift.setups["benchmark"], 20)
    with pytest.raises(ValueError, match="is one of Drift; expected Swing"):
        fit([first, second], Swing.setups["benchmark"], unknown_parameters(Swing(), ["a"]))
