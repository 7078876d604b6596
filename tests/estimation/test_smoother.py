"""The smoother that all share; against closed forms it stands in test_horizon_estimators."""

import many_plants
import numpy as np
import pytest
from linear import record_of

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.smoother import backward, flows, forward
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.model import model_step_moments
from pinnobs_gym.simulation.record import Record


def short_record(name, batch, samples=30):
    source = EpisodeSource(name)
    record = record_of(source, batch)
    y = record.y[:, :samples].copy()
    y[-1, 4:7] = np.nan
    ekf = EKF.for_setup(source.system, source.setup)
    return ekf, Record(record.t[:samples], y, record.u[:, :samples], record.prior)


@pytest.mark.parametrize("name", ["ReverseDuffing", "InductionMotor"])
def test_blocks_and_other_rows_change_nothing(name):
    """All rows together are many more samples than a block holds, and one alone is far fewer."""
    ekf, record = short_record(name, 300)
    about = ekf.run(record).xhat.swapaxes(0, 1)
    whole = [backward(forward(ekf.system, record, ekf.noise, points)) for points in (None, about)]
    for path, points in zip(whole, (None, about), strict=True):
        for row in (0, 1, 299):
            at = None if points is None else points[:, row : row + 1]
            few = forward(ekf.system, record.rows(np.array([row])), ekf.noise, at)
            alone = backward(few)
            size = abs(path.P[..., row]).max(axis=0)
            np.testing.assert_allclose(alone.xhat[:, 0], path.xhat[:, row], rtol=1e-9, atol=1e-9)
            assert (abs(alone.P[..., 0] - path.P[..., row]) <= 1e-9 * size).all()


def test_unless_told_states_it_is_the_extended_filter():
    ekf, record = short_record("ReverseDuffing", 2)
    own = ekf.run(record)
    filtered = forward(ekf.system, record, ekf.noise)
    np.testing.assert_allclose(filtered.xhat.swapaxes(0, 1), own.xhat, rtol=1e-12)
    np.testing.assert_allclose(filtered.P.transpose(3, 0, 1, 2), own.P, rtol=1e-12, atol=1e-18)
    _, F, Q = flows(ekf.system, ekf.noise, record.t, filtered.xhat, record.u.swapaxes(0, 1))
    np.testing.assert_allclose(F, filtered.F, rtol=1e-11, atol=1e-13)
    assert Q.any()
    np.testing.assert_allclose(Q, filtered.Q, rtol=1e-11, atol=1e-18)


def test_caution_takes_smaller_steps():
    ekf, record = short_record("ReverseDuffing", 2)
    bold, careful = (forward(ekf.system, record, ekf.noise, caution=c) for c in (0.0, 0.5))
    taken = [np.einsum("pib,ipb->b", f.H[0], f.K[0]) for f in (bold, careful)]
    # 1 / HK = 1 + R / HPHᵀ, and caution adds itself to R / HPHᵀ
    np.testing.assert_allclose(1 / taken[1], 1 / taken[0] + 0.5, rtol=1e-12)


@pytest.mark.parametrize("plant", [many_plants.cart_with_joined_input, many_plants.henon])
def test_a_step_is_the_same_whatever_other_steps_there_are(plant):
    """At irregular times, over jumps of the model, and where an input meets the kink of a table."""
    system, record = plant(2)
    noise, t, u = EKF(system).noise, record.t, record.u.swapaxes(0, 1)
    x = np.repeat(record.prior.mean[None], len(t), axis=0)
    for k, (end, F, Q) in enumerate(zip(*flows(system, noise, t, x, u), strict=True)):
        alone = model_step_moments(system, noise, t[k], t[k + 1], x[k], u[k], u[k + 1])
        for found, expected in zip((end, F, Q), alone, strict=True):
            expected = np.broadcast_to(expected, found.shape)
            np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)
