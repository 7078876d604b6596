"""Trainings on outputs that are angles: as on those of a sensor that counts turns."""

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import pytest
import torch
from angles import TURN, Compass, Unwrapped, north_record

from pinnobs_gym.estimation.learned.gain_network import Variant, memory_size, shapes
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.system import output_scale
from pinnobs_gym.training.loop import train
from trainers.kkl_supervised import KKLSupervisedTrainer
from trainers.pinn_gain.rollout import FilterState, Model, predict, update
from trainers.pinn_gain.smooth import smooth
from trainers.pinn_obs import guided
from trainers.pinn_obs.fast_recipe import FastRecipe
from trainers.pinn_obs.points import continuous

SETUP = Compass.setups["benchmark"]
BOTH = (Compass(), Unwrapped())


@dataclass(frozen=True)
class Counted(Compass):
    """Its heading counts turns; the readings do not."""

    state_period = None


def rolled(system, record, variant):
    """The estimates (num_samples, nx, batch) of a network of fixed weights, and their gradient by
    the last layer."""
    rng, batch = np.random.default_rng(0), record.batch
    weights = [
        [torch.tensor(0.3 * rng.standard_normal(s)), torch.tensor(0.3 * rng.standard_normal(s[0]))]
        for s in shapes(variant, system.nx, system.ny, 4)
    ]
    weights[-1] = [0.02 * a for a in weights[-1]]  # near the Kalman gain, or near zero
    weights[-1][0].requires_grad_()
    scales = (torch.tensor(a)[:, None] for a in (np.array(system.scale), output_scale(system)))
    noise = EKF.for_setup(system, SETUP).noise
    model = Model(system, variant, *scales, noise)
    first = 1.0 if variant == "kalman" else 0.0
    memory = torch.full((memory_size(variant, 1, 4), batch), first, dtype=torch.float64)
    prior, R = record.prior, torch.tensor(noise.R(0.0)) * torch.ones(batch)
    P = torch.tensor(prior.cov.transpose(1, 2, 0).copy())
    state, states = FilterState(torch.tensor(prior.mean.T), P, memory), []
    for k in range(record.num_samples):
        t = [np.full(batch, record.t[max(k - 1, 0)]), np.full(batch, record.t[k])]
        if k:
            state = predict(model, state, (t[0], t[1]), (record.u[:, k - 1], record.u[:, k]))
        y = torch.tensor(record.y[:, k].T)
        state = update(model, weights, state, (t[1], record.u[:, k]), y, R)
        states.append(state.xhat)
    states = torch.stack(states)
    states[:, 1].square().sum().backward()  # the rate, which whole turns do not change
    return states.detach().numpy(), weights[-1][0].grad.numpy()


@pytest.mark.parametrize("variant", get_args(Variant))
def test_the_rollout_of_learned_gains_takes_angles_the_shorter_way(variant):
    _, *records = north_record(Compass())
    records = [record.rows(slice(0, 2)).first_samples(40) for record in records]
    assert abs(records[0].y - records[1].y).max() > 6  # some readings jump
    systems = Counted(), Unwrapped()
    (found, slope), (expected, same) = (
        rolled(system, record, variant) for system, record in zip(systems, records, strict=True)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(slope, same, rtol=1e-9)


@pytest.mark.parametrize("variant", get_args(Variant))
def test_a_network_does_not_see_whole_turns(variant):
    _, record, _ = north_record(Compass())
    record = record.rows(slice(0, 2)).first_samples(40)
    mean = record.prior.mean + np.array([[0.0, 0.0], [20 * TURN, 0.0]])
    moved = replace(record, prior=replace(record.prior, mean=mean))
    (expected, slope), (found, same) = (rolled(Compass(), r, variant) for r in (record, moved))
    turns = np.array([[0.0, 20 * TURN], [0.0, 0.0]])
    np.testing.assert_allclose(found - turns, expected, atol=1e-9)
    np.testing.assert_allclose(same, slope, rtol=1e-8)


def test_smoothed_trajectories_of_a_compass_are_explained():
    _, *records = north_record(Compass())
    found, expected = (
        smooth(record, EKF.for_setup(system, SETUP))
        for system, record in zip(BOTH, records, strict=True)
    )
    assert found.explained.all()
    off = Compass().state_residual(found.xhat, expected.xhat)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def recipe(system, record):
    return FastRecipe(system, replace(guided(), points=60, width=6), record, system.noise(0.05))


def turning():
    """A record of a compass that turns twice, with a missing sample, and the one without jumps."""
    _, *records = north_record(Compass())
    records = [record.rows(slice(2, 3)) for record in records]
    for record in records:
        record.y[0, 7] = np.nan
    return records


def test_outputs_are_interpolated_without_jumps():
    wrapped, plain = turning()
    found = continuous(Compass(), wrapped).y
    turns = (found - plain.y)[~np.isnan(plain.y)] / TURN
    np.testing.assert_allclose(turns, np.round(turns[0]), atol=1e-12)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(plain.y))
    assert continuous(Unwrapped(), plain) is plain


def test_the_loss_of_pinn_obs_does_not_change_with_whole_turns():
    """Its value and gradient, and the guide, on the record and on one moved by whole turns."""
    wrapped, plain = turning()
    turns = np.random.default_rng(0).integers(-2, 3, wrapped.y.shape)
    moved = replace(wrapped, y=wrapped.y + TURN * turns)
    first, other = (recipe(Compass(), record) for record in (wrapped, moved))
    expected = recipe(Unwrapped(), plain)
    for each in (first, other):
        assert each.guide is not None
        assert expected.guide is not None
        np.testing.assert_allclose(each.guide.xhat, expected.guide.xhat, atol=1e-6)
    for seed in range(3):
        theta = first.draw(torch.Generator().manual_seed(seed))
        loss, gradient = first.objective(theta)
        again, same = other.objective(theta)
        assert again == pytest.approx(loss, rel=1e-9)
        np.testing.assert_allclose(same, gradient, rtol=1e-6, atol=1e-9 * abs(gradient).max())


def test_the_gradient_with_angles_is_that_of_finite_differences():
    own = recipe(Compass(), turning()[0])
    theta = own.draw(torch.Generator().manual_seed(0))
    _, gradient = own.objective(theta)
    rng = np.random.default_rng(1)
    for _ in range(5):
        direction = rng.standard_normal(len(theta))
        step = 1e-6 * direction
        slope = (own.objective(theta + step)[0] - own.objective(theta - step)[0]) / 2e-6
        assert slope == pytest.approx(gradient @ direction, rel=1e-5, abs=1e-5 * abs(slope) + 1e-6)


def test_no_kkl_observer_is_trained_on_an_angle():
    _, record, _ = north_record(Compass())
    config = KKLSupervisedTrainer.configured({})
    with pytest.raises(ValueError, match="takes no outputs with a period"):
        train(KKLSupervisedTrainer(Compass(), config, record=record, noise_std=0.05))
