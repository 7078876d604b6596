"""The shared gain: what it equals, what its training may see, and its files."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import get_args

import numpy as np
import pytest
import torch
from learned_gains import gain_of
from linear import Linear, Modulated, fed_through

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.checks import ESTIMATOR_CHECKS
from pinnobs_gym.estimation.kalman import update_with
from pinnobs_gym.estimation.learned.gain_network import (
    Variant,
    memory_size,
    update_with_network,
)
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_gain import PinnGain
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import output_scale
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.training.loop import train as run
from pinnobs_gym.training.trainer import TRAINING_SEED
from trainers.pinn_gain import PinnGainConfig, PinnGainTrainer
from trainers.pinn_gain.rollout import FilterState, Model, predict, update
from trainers.pinn_gain.smooth import smooth

SMALL = PinnGainConfig(
    episodes=10, held_out=3, width=6, iterations=6, streams=6, chunk=10, check_every=2, log_every=2
)


def train(system, config, *, record, noise_std=None, **options):
    """What comes of a training."""
    return run(PinnGainTrainer(system, config, record=record, noise_std=noise_std), **options)


def played(name, seeds, duration=None, **changes):
    source = EpisodeSource(name, duration=duration, **changes)
    streams = source.streams(seeds)
    episodes = source.play(source.draw(streams))
    return source, source.record(episodes), episodes.x[:-1].swapaxes(0, 1)


def short_record(batch=10, **changes):
    source, record, _ = played("ReverseDuffing", range(7, 7 + batch), 1.0, **changes)
    return source.system, record


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_a_network_that_changes_nothing_is_the_ekf(name):
    source, record, _ = played(name, range(3))
    record = Record(record.t[:300], record.y[:, :300].copy(), record.u[:, :300], record.prior)
    record.y[0, 5:9] = np.nan
    std = tuple(np.broadcast_to(source.setup.noise_std, source.system.ny).tolist())
    ekf = EKF.for_setup(source.system, source.setup).run(record)
    own = gain_of(source.system, noise_std=std).run(record)
    for field in fields(ekf):
        expected = getattr(ekf, field.name)
        if expected is None:  # neither tells it
            assert getattr(own, field.name) is None
            continue
        np.testing.assert_allclose(
            getattr(own, field.name), expected, rtol=1e-11, atol=1e-11 * abs(expected).max()
        )


@pytest.mark.parametrize("variant", get_args(Variant))
@pytest.mark.parametrize("name", ["HarmonicOscillator", "InductionMotor", Modulated])
def test_online_and_training_compute_the_same(name, variant):
    source, record, _ = played(name, range(4), 20 * EpisodeSource(name).setup.dt)
    system = source.system
    gain = gain_of(system, 5e-3 if variant == "kalman" else 1e-3, variant)
    found = gain.run(record)
    ekf = EKF(system, gain.noise_std)
    scale, size = (torch.tensor(a)[:, None] for a in (np.array(system.scale), output_scale(system)))
    R = torch.tensor(ekf.noise.R(0.0))
    model = Model(system, variant, scale, size, ekf.noise)
    weights = [(torch.tensor(W), torch.tensor(b)) for W, b in gain.trained.layers]
    count = memory_size(variant, system.ny, 8)
    memory = torch.full((count, 4), 1.0 if variant == "kalman" else 0.0, dtype=torch.float64)
    prior = record.prior
    moment = FilterState(
        torch.tensor(prior.mean.T), torch.tensor(prior.cov.transpose(1, 2, 0).copy()), memory
    )
    for k in range(record.num_samples):
        if k:
            t = np.full(4, record.t[k - 1]), np.full(4, record.t[k])
            moment = predict(model, moment, t, (record.u[:, k - 1], record.u[:, k]))
        now = np.full(4, record.t[k]), record.u[:, k]
        y, R_rows = torch.tensor(record.y[:, k].T), R * torch.ones(4)
        moment = update(model, weights, moment, now, y, R_rows)
        error = abs(moment.xhat.numpy().T - found.xhat[:, k]) / np.array(system.scale)
        assert error.max() < 1e-10
        if found.P is not None:
            P = moment.P.numpy().transpose(2, 0, 1)
            assert abs(P - found.P[:, k]).max() < 1e-10 * abs(P).max()
    assert (found.P is None) == (variant == "gru")


def test_online_and_training_count_a_share_below_zero_as_zero():
    """HPHᵀ is below zero by rounding alone; the root of its share of S enters the network."""
    gain, rng = gain_of(ReverseDuffing(), 0.1), np.random.default_rng(0)
    arrays = (
        np.ones((2, 1)),
        rng.standard_normal((2, 1)),
        np.array([[1.0, 1.0 + 1e-6], [1.0 + 1e-6, 1.0]])[..., None],
        rng.standard_normal((1, 1)),
        np.array([[1.0, -1.0]])[..., None],
        np.full((1, 1, 1), 0.01),
        np.ones((1, 1)),
        np.ones((1, 1), dtype=bool),
    )
    found = update_with_network(gain.trained.layers, *arrays)
    weights = [(torch.tensor(W), torch.tensor(b)) for W, b in gain.trained.layers]
    other = update_with_network(weights, *map(torch.tensor, arrays))
    for a, b in zip(found, other, strict=True):
        np.testing.assert_allclose(b.numpy(), a, rtol=1e-12)
        assert np.isfinite(a).all()


def test_a_known_part_of_the_outputs_changes_no_training():
    """Smoothing, streams and held-out episodes see h at each sample's own time and input."""
    _, record, _ = played(Linear, range(10), 2.0)
    system, fed = fed_through(record, measured=True)
    smoothed = [smooth(r, EKF(s, 0.1)).xhat for s, r in ((Linear(), record), (system, fed))]
    np.testing.assert_allclose(*smoothed, atol=1e-9)
    plain, own = (train(s, SMALL, record=r) for s, r in ((Linear(), record), (system, fed)))
    assert plain.iterations == own.iterations == 6
    assert own.loss == pytest.approx(plain.loss, rel=1e-6)
    for ours, theirs in zip(own.layers, plain.layers, strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)


def test_rows_may_have_times_of_their_own():
    system = SYSTEMS.resolve("InductionMotor")()
    x = np.random.default_rng(0).normal([1, 1, 0.5, 0.5, 100], 1.0, (2, 5))
    t = np.array([0.1, 0.3])
    together = model_step_jacobian(system, t, t + 1e-3, x)
    for i in range(2):
        alone = model_step_jacobian(system, t[i], t[i] + 1e-3, x[i : i + 1])
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[i], b[0], rtol=1e-12, atol=1e-12)


def test_the_gradient_is_that_of_the_linearised_rollout():
    """Where the model is linear, nothing is left out of the gradient."""
    system, count = Linear(), 3
    scale, one = torch.ones(2, 1, dtype=torch.float64), torch.ones(2, 1, dtype=torch.float64)
    noise = EKF(system, 0.1).noise
    R, model = torch.tensor(noise.R(0.0)), Model(system, "kalman", scale, one, noise)
    rng = np.random.default_rng(0)
    y = torch.tensor(rng.standard_normal((6, 2, count)))
    last, way = (torch.tensor(0.1 * rng.standard_normal((8, 8))) for _ in range(2))
    last.requires_grad_()
    layers = [tuple(map(torch.tensor, layer)) for layer in gain_of(system).trained.layers]

    def loss(weights):
        moment = FilterState(
            torch.zeros(2, count, dtype=torch.float64),
            torch.eye(2, dtype=torch.float64)[..., None].expand(2, 2, count),
            torch.ones(2, count, dtype=torch.float64),
        )
        for k in range(6):
            t = np.full(count, 0.1 * k), np.full(count, 0.1 * k + 0.1)
            u = (np.zeros((count, 0)),) * 2
            moment = predict(model, moment, t, u)
            network = [*layers[:2], (weights, layers[2][1])]
            now = np.full(count, 0.1 * k), np.zeros((count, 0))
            moment = update(model, network, moment, now, y[k], R * torch.ones(count))
        return moment.xhat.square().sum() + moment.P.sum()

    (gradient,) = torch.autograd.grad(loss(last), last)
    with torch.no_grad():
        slope = (loss(last + 1e-5 * way) - loss(last - 1e-5 * way)) / 2e-5
    assert float((gradient * way).sum()) == pytest.approx(float(slope), rel=1e-6)


def test_on_a_linear_system_P_is_the_covariance_of_any_gain(monkeypatch):
    """Errors of a linear filter with known gains are sums over all independent noises."""
    gains = []

    def spy(K, *others):
        gains.append(K[..., 0])
        return update_with(K, *others)

    monkeypatch.setattr("pinnobs_gym.estimation.learned.gain_network.update_with", spy)
    source, record, _ = played(Linear, range(1))
    system = source.system
    gain = gain_of(system, 1.0, noise_std=(0.1, 0.1))
    gain = replace(gain, assumed_noise=0.0)
    found = gain.run(record)
    H = system.h_jacobian(0.0, np.zeros(2), np.empty(0))
    F = model_step_jacobian(system, 0.0, 0.1, np.zeros((1, 2)))[1][0]
    roots = np.linalg.cholesky(record.prior.cov[0])  # the error is roots @ unit noises
    for k, K in enumerate(gains):
        if k:
            roots = F @ roots
        roots = np.concatenate([(np.eye(2) - K @ H) @ roots, -0.1 * K], axis=1)
        expected = roots @ roots.T
        np.testing.assert_allclose(found.P[0, k], expected, atol=1e-9 * abs(expected).max())


NOT_PASSED = [
    ("kalman", "ReverseDuffing", "sampled_noise"),
    ("gru", "ReverseDuffing", "sampled_noise"),
    ("gru", "InductionMotor", "sampled_noise"),
    ("gru", "InductionMotor", "noise_matrix"),
]
"""Variant, system and check that it is exempt from."""


@pytest.mark.parametrize("check", ESTIMATOR_CHECKS)
@pytest.mark.parametrize("name", ["ReverseDuffing", "InductionMotor"])
@pytest.mark.parametrize("variant", get_args(Variant))
def test_it_conforms(variant, name, check):
    made = gain_of(SYSTEMS.resolve(name)(), 1e-3, variant)
    if check not in made.exempt_from:
        ESTIMATOR_CHECKS[check](made)
    elif (variant, name, check) in NOT_PASSED:
        with pytest.raises(CheckFailed, match=f"^{check}: "):
            ESTIMATOR_CHECKS[check](made)


@pytest.mark.parametrize("name", ["ReverseDuffing", "Satellite"])
def test_smoothed_trajectories_are_nearer_than_filtered_ones(name):
    source, record, x = played(name, range(8), 4.0)
    ekf = EKF.for_setup(source.system, source.setup)
    smoothed = smooth(record, ekf)
    error = abs(smoothed.xhat - x)[smoothed.explained]
    assert smoothed.explained.sum() >= 7
    assert (error / np.array(source.system.scale)).max() < 0.05
    assert error[:, 0].max() < 0.2 * abs(ekf.run(record).xhat - x)[:, 0].max()


def test_outputs_that_no_trajectory_of_the_model_has_are_not_explained():
    source, record, _ = played("ReverseDuffing", range(3), 2.0)
    record.y[1, 50:] += np.where(np.arange(50) % 2, 3.0, -3.0)[:, None]
    explained = smooth(record, EKF.for_setup(source.system, source.setup)).explained
    assert explained.tolist() == [True, False, True]


@pytest.mark.parametrize("variant", get_args(Variant))
def test_the_same_seed_gives_the_same_weights_and_resuming_is_exact(tmp_path, variant):
    system, record = short_record()
    config = replace(SMALL, variant=variant)
    straight = train(system, config, record=record)
    again = train(system, config, record=record)
    path = tmp_path / "checkpoint.pt"
    train(system, replace(config, iterations=3), record=record, checkpoint=path)
    resumed = train(system, config, record=record, checkpoint=path, resume=True)
    other = train(system, replace(config, seed=1), record=record)
    for same in (again, resumed):
        assert (same.loss, same.iterations, same.seed) == (straight.loss, 6, 0)
        for a, b in zip(same.layers, straight.layers, strict=True):
            np.testing.assert_array_equal(a[0], b[0])
    assert not np.array_equal(other.layers[0][0], straight.layers[0][0])


def test_training_is_not_worse_than_the_ekf_on_the_records_held_out():
    system, record = short_record(32)
    sizes = {"episodes": 32, "held_out": 8, "width": 16, "streams": 64, "chunk": 25}
    config = replace(SMALL, **sizes, iterations=40, learning_rate=3e-3, check_every=20)
    trained = train(system, config, record=record)
    assert trained.loss < 0.9
    assert trained.noise_std == (0.02,)
    wild = replace(SMALL, learning_rate=50.0)
    assert train(system, wild, record=record.rows(slice(10))).loss <= 1


def test_records_held_out_are_filtered_with_the_process_noise_told(monkeypatch):
    gains = []

    def spy(*told, **options):
        gains.append(PinnGain(*told, **options))
        return gains[-1]

    monkeypatch.setattr("trainers.pinn_gain.held_out.PinnGain", spy)
    system, record = short_record()
    PinnGainTrainer(system, SMALL, record=record, process_noise=(0.0, 0.3))
    expected = EKF(system, process_noise=(0.0, 0.3)).noise.L(0.0)
    assert len(gains) > 1
    for gain in gains:
        np.testing.assert_array_equal(gain.noise.L(0.0), expected)


def test_training_sees_a_record_alone(monkeypatch):
    """Whoever trains gets outputs, inputs, times and the prior; the truth is computed before."""
    game = Game.of("ReverseDuffing")
    record = game.record(range(TRAINING_SEED, TRAINING_SEED + 10))
    assert record.batch == 10
    assert [f.name for f in fields(record)] == ["t", "y", "u", "prior", "noise_std"]
    record = Record(record.t[:50], record.y[:, :50], record.u[:, :50], record.prior)

    def refuse(*args, **kwargs):
        raise AssertionError("the true plant is simulated")

    monkeypatch.setattr("pinnobs_gym.simulation.truth.truth", refuse)
    monkeypatch.setattr("pinnobs_gym.envs.episodes.truth", refuse)
    system, setup = game.source.system, game.source.setup
    train(system, SMALL, record=record, noise_std=setup.noise_std)


def test_a_file_is_told_the_noise_it_was_trained_at_and_refuses_others(tmp_path):
    gain, path = gain_of(ReverseDuffing(), 0.1), tmp_path / "gain.pt"
    gain.save(path)
    loaded = PinnGain.load(path, ReverseDuffing())
    assert loaded.noise_std == (0.02,)
    assert loaded.training["trainer"] == "pinn_gain"
    for system, what in (
        (SYSTEMS.resolve("Academic")(), "system='ReverseDuffing'; expected 'Academic'"),
        (SYSTEMS.resolve("Satellite")(), "expected 'Satellite'"),
    ):
        with pytest.raises(ValueError, match=what):
            PinnGain.load(path, system)
    one, two = (SYSTEMS.resolve("Satellite")(measure_x3=m) for m in (False, True))
    gain_of(one).save(path)
    with pytest.raises(ValueError, match="measure_x3=False; expected True"):
        PinnGain.load(path, two)
    trained = gain_of(one).trained
    wrong = tuple((W[:, :-1], b) for W, b in trained.layers)
    replace(trained, layers=wrong).save(path)
    with pytest.raises(ValueError, match="was trained with sizes="):
        PinnGain.load(path, one)
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is damaged or no file of saved weights"):
        PinnGain.load(path, one)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"variant": "lstm"}, "variant='lstm'; expected kalman or gru"),
        ({"episodes": 3}, "episodes=3; expected a whole number over held_out=3"),
        ({"width": 0}, "width=0; expected a whole number of at least 1"),
        ({"learning_rate": -1.0}, "learning_rate=-1.0; expected a positive number"),
        ({"budget": 0.0}, "budget=0.0; expected None or positive seconds"),
        ({"seed": -1}, "seed=-1; expected"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change)


def test_records_that_cannot_be_trained_on_are_refused(tmp_path):
    system, record = short_record()
    with pytest.raises(ValueError, match="holds 4 episodes; expected 10"):
        train(system, SMALL, record=record.rows(slice(4)))
    with pytest.raises(ValueError, match="resume=True without a checkpoint"):
        train(system, SMALL, record=record, resume=True)
    noise = np.random.default_rng(0).standard_normal(record.y.shape)
    with pytest.raises(ValueError, match="explains the outputs of 0 of 10 records"):
        train(system, SMALL, record=replace(record, y=record.y + 5 * noise))
    path = tmp_path / "checkpoint.pt"
    train(system, replace(SMALL, iterations=1), record=record, checkpoint=path)
    shifted = replace(record, y=record.y + 1e-3)
    with pytest.raises(ValueError, match="trained on another record: its y differs"):
        train(system, SMALL, record=shifted, checkpoint=path, resume=True)
    with pytest.raises(ValueError, match="trained with seed=0; expected 1"):
        train(system, replace(SMALL, seed=1), record=record, checkpoint=path, resume=True)
    with pytest.raises(ValueError, match="sample times are irregular"):
        train(system, SMALL, record=replace(record, t=record.t**1.1))


def test_a_loss_that_is_not_finite_from_any_seed_ends_in_one_line(monkeypatch):
    system, record = short_record()
    monkeypatch.setattr(PinnGainTrainer, "_loss", lambda self, P, errors: np.nan * errors.sum())
    with pytest.raises(FloatingPointError, match="from seed 0 and the 3 after it") as caught:
        train(system, replace(SMALL, iterations=100), record=record)
    assert "\n" not in str(caught.value)
