"""Outputs that depend on time and input: estimators against closed forms, and against themselves on
the outputs less what is known of them."""

from dataclasses import replace

import numpy as np
import pytest
from kinds import FEW, untrained
from linear import (
    FeedThrough,
    Linear,
    Modulated,
    fed_through,
    jacobians,
    kalman_filter,
    linear_record,
    process_covariance,
    runge_kutta_matrix,
)
from small_trainings import constant_gain

from pinnobs_gym.envs.actions import form_of, typical
from pinnobs_gym.estimation.checks import check_estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.system import System

MEASURED = pytest.mark.parametrize("measured", [False, True], ids=["known", "measured"])
STD = (0.1, 0.2)
NOISE = pytest.mark.parametrize(("process_noise", "atol"), [(0.0, 1e-11), (0.15, 1e-6)])
"""Process noise per √s, and the tolerance; see `linear.NOISE_OF_FILTERS`."""


def modulated_record(measured):
    """`Modulated` and a record of it: the modulation is added to outputs of `FeedThrough`."""
    plain = linear_record()
    system, record = fed_through(plain, measured)
    system = Modulated(measured_input=measured)
    rng = np.random.default_rng(1)
    x = rng.uniform(-1, 1, (plain.batch, 1, 2)) @ np.eye(2)
    states = [x[:, 0]]
    for _ in plain.t[1:]:
        states.append(states[-1] @ runge_kutta_matrix(0.1).T)
    x = np.stack(states, axis=1)
    C = np.stack([jacobians(system, plain.t, u) for u in record.u])
    y = np.einsum("bkij,bkj->bki", C, x) + record.y - plain.y
    return system, replace(record, y=y + 0.1 * rng.standard_normal(y.shape)), x


def known_part(record):
    """Du + (sin 3t, 0)/2 of a record, as numbers."""
    sine = 0.5 * np.sin(3 * record.t)
    first = 0.7 * record.u[..., 0] + sine
    return np.stack([first, -1.1 * record.u[..., 0]], axis=-1)


def smoothed(record, row, process_noise, C):
    """Rauch, Tung and Striebel's recursion of the linear system, from the last sample on."""
    F, Q = runge_kutta_matrix(0.1), process_covariance(process_noise)
    filtered = [
        (peer.x.copy(), peer.P.copy()) for peer in kalman_filter(record, row, process_noise, STD, C)
    ]
    path = [filtered[-1]]
    for x, P in reversed(filtered[:-1]):
        later_x, later_P = path[-1]
        ahead = F @ P @ F.T + Q
        gain = P @ F.T @ np.linalg.inv(ahead)
        path.append((x + gain @ (later_x - F @ x), P + gain @ (later_P - ahead) @ gain.T))
    return path[::-1]


@MEASURED
@NOISE
@pytest.mark.parametrize("kind", [EKF, UKF, CKF])
def test_filters_are_the_kalman_filter_less_what_is_known(kind, process_noise, atol, measured):
    system, record, _ = modulated_record(measured)
    own = kind(system, STD, process_noise, assumed_noise=0.0).run(record)
    plain = replace(record, y=record.y - known_part(record))
    for i in range(record.batch):
        C = jacobians(system, record.t, record.u[i])
        for k, peer in enumerate(kalman_filter(plain, i, process_noise, STD, C)):
            np.testing.assert_allclose(own.xhat[i, k], peer.x, atol=atol)
            np.testing.assert_allclose(own.P[i, k], peer.P, atol=atol)
            np.testing.assert_allclose(own.S[i, k], peer.S, atol=atol)
            np.testing.assert_allclose(own.innovation[i, k], peer.y, atol=atol)


@MEASURED
@pytest.mark.parametrize("window", [5, 1000])
def test_moving_horizons_are_the_kalman_filter(window, measured):
    system, record, _ = modulated_record(measured)
    own = MHE(system, noise_std=STD, assumed_noise=0.0, window=window).run(record)
    plain = replace(record, y=record.y - known_part(record))
    for i in range(record.batch):
        C = jacobians(system, record.t, record.u[i])
        for k, peer in enumerate(kalman_filter(plain, i, 0.0, STD, C)):
            np.testing.assert_allclose(own.xhat[i, k], peer.x, atol=1e-9)
            np.testing.assert_allclose(own.P[i, k], peer.P, atol=1e-9)
            np.testing.assert_allclose(own.innovation[i, k], peer.y, atol=1e-9)


@MEASURED
@NOISE
def test_the_smoother_is_the_textbooks(process_noise, atol, measured):
    system, record, _ = modulated_record(measured)
    own = RTSSmoother(system, STD, process_noise, assumed_noise=0.0).run(record)
    plain = replace(record, y=record.y - known_part(record))
    for i in range(record.batch):
        C = jacobians(system, record.t, record.u[i])
        for k, (x, P) in enumerate(smoothed(plain, i, process_noise, C)):
            np.testing.assert_allclose(own.xhat[i, k], x, atol=atol)
            np.testing.assert_allclose(own.P[i, k], P, atol=atol)


@MEASURED
def test_least_squares_are_the_normal_equations(measured):
    system, record, _ = modulated_record(measured)
    own = BatchLeastSquares(system, noise_std=STD).run(record)
    y = record.y - known_part(record)
    R_inverse, F = np.diag(1 / np.square(STD)), runge_kutta_matrix(0.1)
    for i in range(record.batch):
        C, Phi = jacobians(system, record.t, record.u[i]), np.eye(2)
        information = np.linalg.inv(record.prior.cov[i])
        right = information @ record.prior.mean[i]
        for k in range(record.num_samples):
            G = C[k] @ Phi
            information = information + G.T @ R_inverse @ G
            right = right + G.T @ R_inverse @ y[i, k]
            Phi = F @ Phi
        x, P = np.linalg.solve(information, right), np.linalg.inv(information)
        for k in range(record.num_samples):
            np.testing.assert_allclose(own.xhat[i, k], x, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(own.P[i, k], P, rtol=1e-9, atol=1e-13)
            x, P = F @ x, F @ P @ F.T


@MEASURED
@pytest.mark.parametrize("name", untrained())
def test_a_known_part_of_the_outputs_changes_no_estimate(name, measured):
    """Every estimator, with missing outputs and with each row's own input."""
    plain = linear_record()
    plain.y[0, 4], plain.y[1, 7:9, 1] = np.nan, np.nan
    system, record = fed_through(plain, measured)
    cls = ESTIMATORS.resolve(name)
    expected, found = (
        cls(Linear(), noise_std=STD).run(plain),
        cls(system, noise_std=STD).run(record),
    )
    for part in ("xhat", "P", "innovation", "S"):
        if (value := getattr(expected, part)) is not None:
            np.testing.assert_allclose(getattr(found, part), value, rtol=1e-9, atol=1e-9)


def test_the_jacobians_by_hand_are_those_of_automatic_differentiation():
    rng = np.random.default_rng(0)
    t, x, u = rng.random((3, 1)), rng.standard_normal((3, 4, 2)), rng.standard_normal((3, 4, 1))
    for system in (FeedThrough(), Modulated()):
        for name in ("f_jacobian", "h_jacobian"):
            expected = getattr(System, name)(system, t, x, u)
            np.testing.assert_allclose(getattr(system, name)(t, x, u), expected, rtol=1e-14)


@pytest.mark.parametrize("name", untrained())
def test_they_keep_to_the_rules(name):
    check_estimator(ESTIMATORS.resolve(name)(Modulated(), **FEW.get(name, {})))


@pytest.mark.parametrize("design", ["poles", "lmi"])
def test_gains_are_designed_on_the_output_then(design):
    """`Modulated` with its modulation is not `FeedThrough` with the same A."""
    plain, modulated = (
        Luenberger(cls(), design=design, rate=1.0).designed() for cls in (FeedThrough, Modulated)
    )
    np.testing.assert_allclose(
        plain, Luenberger(Linear(), design=design, rate=1.0).designed(), rtol=1e-6
    )
    assert abs(modulated - plain).max() > 1e-3


@MEASURED
def test_the_replay_solves_the_observers_equation(measured):
    """Outputs are joined by straight lines, so their known part has to be linear in between: here
    the input alone, at fine samples against Euler's own of h at each time."""
    system = FeedThrough(measured_input=measured)
    plain = linear_record(1)
    system, record = fed_through(plain, measured)
    L = np.array([[0.8, 0.1], [-0.2, 0.6]])
    own = PinnObsReplay(system, trained=constant_gain(system, L, record)).run(record).xhat[0]
    x = record.prior.mean[0]
    for k in range(1, record.num_samples):
        steps = 200
        for part in (np.arange(steps) + 0.5) / steps:
            t = record.t[k - 1] + part * 0.1
            y = record.y[0, k - 1] + part * (record.y[0, k] - record.y[0, k - 1])
            u = system.input(np.asarray(t))
            if measured:
                u = record.u[0, k - 1] + part * (record.u[0, k] - record.u[0, k - 1])
            offset = [0.7 * u[0] + 0.5 * np.sin(3 * t), -1.1 * u[0]]
            drift = np.array([[0.0, 1.0], [-2.0, -0.3]]) - L @ np.diag([1.0, 2.0])
            middle = x + 0.05 / steps * (drift @ x + L @ (y - offset))
            x = x + 0.1 / steps * (drift @ middle + L @ (y - offset))
        np.testing.assert_allclose(own[k], x, atol=1e-5)


def test_the_replays_rows_are_independent_where_the_input_sets_the_step():
    system, record, _ = modulated_record(True)
    record = replace(record, u=record.u * np.array([0.1, 20.0, 3.0])[:, None, None])
    L = np.array([[30.0, 0.0], [0.0, 10.0]])
    replay = PinnObsReplay(system, trained=constant_gain(system, L, record.rows(slice(0, 1))))
    together = replay.run(record).xhat
    for i in range(record.batch):
        alone = replay.run(record.rows(slice(i, i + 1))).xhat[0]
        np.testing.assert_allclose(together[i], alone, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("mode", ["gain", "correction"])
def test_a_form_of_actions_takes_the_known_part_off(mode):
    plain = linear_record()
    system, record = fed_through(plain, False)
    setup = Linear.setups["benchmark"]
    for ours, theirs in zip(typical(system, setup), typical(Linear(), setup), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    forms = form_of(mode, system, setup), form_of(mode, Linear(), setup)
    memories = [
        form.begin(r.prior.mean, np.zeros(3), r.u[:, 0])
        for form, r in zip(forms, (record, plain), strict=True)
    ]
    for k in range(5):
        t = np.full(3, plain.t[k])
        ours, memories[0] = forms[0].observe(memories[0], t, record.y[:, k], record.u[:, k])
        theirs, memories[1] = forms[1].observe(memories[1], t, plain.y[:, k], plain.u[:, k])
        assert abs(theirs[:, :2]).max() > 0.1
        np.testing.assert_allclose(np.delete(ours, 4, axis=1), theirs, atol=1e-12)


def test_without_a_prediction_step_h_is_that_of_the_sample():
    """The first innovation is y₀ − h(t₀, x̂₀, u₀), at a first time that is not zero."""
    system, record, _ = modulated_record(True)
    late = replace(record, t=record.t + 0.37)
    innovation = EKF(system, noise_std=STD).run(late).innovation[:, 0]
    expected = record.y[:, 0] - system.h(0.37, record.prior.mean, record.u[:, 0])
    np.testing.assert_allclose(innovation, expected, atol=1e-15)
    state = EKF(system, noise_std=STD).reset(record.prior)
    state = EKF(system).update(state, 0.37, record.y[:, 0], record.u[:, 0])
    later = EKF(system).update(state, 0.47, record.y[:, 1], record.u[:, 1])
    ahead = model_step(system, 0.37, 0.47, state.xhat, record.u[:, 0], record.u[:, 1])
    expected = record.y[:, 1] - system.h(0.47, ahead, record.u[:, 1])
    np.testing.assert_allclose(later.innovation, expected, atol=1e-14)
