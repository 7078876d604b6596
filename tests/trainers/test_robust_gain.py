"""The bank of filters under beliefs: against Bayesian averages of Kalman filters, and its training
against derivatives, known proportions and a plant that escapes."""

import logging
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from angles import Compass
from linear import H, Linear, process_covariance, runge_kutta_matrix
from other_motions import Counted, Exact
from pendulum import NoisyPendulum
from quick_trainings import QUICK, made
from scipy.stats import multivariate_normal

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.learned.beliefs import Beliefs, divided
from pinnobs_gym.estimation.learned.trained_file import identity
from pinnobs_gym.estimators import robust_gain
from pinnobs_gym.estimators.robust_gain import RobustGain, TrainedBeliefs
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.training.by_name import train_by_name, trainer_of
from pinnobs_gym.training.checkpoint import save_checkpoint
from trainers.robust_gain.conditions import draw_condition
from trainers.robust_gain.fitting import Evidence, fit


def bank(system, noises, weights, noise_std=0.1, leak=0.0):
    """A bank of one filter for each process noise, from the prior as it is."""
    count, nx = len(noises), system.nx
    beliefs = Beliefs(
        assumed_noise=np.array(noises, dtype=float),
        deviation=np.zeros(count),
        outliers=np.zeros(count),
        absolute=np.zeros(count, dtype=bool),
        weight=np.array(weights, dtype=float),
        belief=np.arange(count),
        share=np.ones(count),
        mean=np.zeros((count, nx)),
        cov=np.tile(np.eye(nx), (count, 1, 1)),
    )
    about = {n: identity(system)[n] for n in ("system", "parameters")}
    trained = TrainedBeliefs(
        **about,
        trainer="robust_gain",
        noise_std=(noise_std,) * system.ny,
        condition="nominal",
        config={},
        seed=0,
        loss=0.0,
        iterations=0,
        seconds=0.0,
        ending="finished",
        beliefs=beliefs,
        leak=leak,
    )
    return RobustGain(system, noise_std, trained=trained)


def averaged(record, row, noises, weights):
    """The estimates of Kalman filters, weighted by the densities of all outputs so far."""
    F, R, log, filters = runge_kutta_matrix(0.1), 0.01 * np.eye(2), np.log(weights), []
    for noise in noises:
        x, P = record.prior.mean[row], record.prior.cov[row]
        filters.append([x, P, process_covariance(noise / np.sqrt(2.0))])
    found = []
    for k in range(record.num_samples):
        for i, (x, P, Q) in enumerate(filters):
            if k:
                x, P = F @ x, F @ P @ F.T + Q
            S = H @ P @ H.T + R
            e = record.y[row, k] - H @ x
            log[i] += multivariate_normal(cov=S).logpdf(e)
            K = P @ H.T @ np.linalg.inv(S)
            filters[i][:2] = x + K @ e, P - K @ S @ K.T
        w = np.exp(log - log.max())
        w /= w.sum()
        mean = sum(a * x for a, (x, _, _) in zip(w, filters, strict=True))
        cov = sum(
            a * (P + np.outer(x - mean, x - mean)) for a, (x, P, _) in zip(w, filters, strict=True)
        )
        found.append((mean, cov, w))
    return [np.array(part) for part in zip(*found, strict=True)]


def test_it_is_the_bayesian_average_of_kalman_filters(monkeypatch):
    monkeypatch.setattr(robust_gain, "_UNLIKELY", 0.0)  # unlikely hypotheses are not left out
    noises, weights = (0.2, 2.0), (0.7, 0.3)
    record = Game.of(Linear, condition="process_noise1e-2").record(range(3))
    estimator = bank(Linear(), noises, weights)
    found = estimator.run(record)
    for row in range(3):
        mean, cov, w = averaged(record, row, noises, np.array(weights))
        # Q by Simpson's rule over a step is that of the exponential to 1e-5
        np.testing.assert_allclose(found.xhat[row], mean, atol=1e-5)
        np.testing.assert_allclose(found.P[row], cov, atol=1e-5)
        np.testing.assert_allclose(estimator.beliefs(record)[row], w, atol=1e-3)


def test_a_belief_that_is_lost_has_no_part_and_all_lost_are_not_finite():
    record = Game.of(Linear).record(range(2))
    estimator = bank(Linear(), (0.2, 2.0), (0.5, 0.5))
    sound = bank(Linear(), (2.0,), (1.0,)).run(record)
    found = estimator.hypotheses(record)
    xhat = found.xhat.copy()
    xhat[0, 0, 5:] = np.nan
    xhat[1, :, 5:] = np.nan
    missing, ones = np.isnan(record.y), np.full((2, 2), 0.5)
    R = estimator.noise.R(0.0)[None]
    mixed, _, lost = estimator._mixed(
        replace(found, xhat=xhat), R, missing, ones, np.zeros((2, 2), dtype=bool)
    )
    np.testing.assert_allclose(mixed.xhat[0, 5:], sound.xhat[0, 5:], rtol=1e-12)
    assert np.isfinite(mixed.xhat[1, :5]).all()
    assert np.isnan(mixed.xhat[1, 5:]).all()
    assert lost.tolist() == [[True, False], [True, True]]


def test_parts_of_a_law_have_its_mean_and_covariance():
    draws = np.random.default_rng(1).uniform(-1, 2, (2000, 3))
    for number in (1, 5):
        share, mean, cov = divided(draws, number, 0)
        np.testing.assert_allclose(share @ mean, draws.mean(axis=0), atol=1e-12)
        second = np.einsum("k,kij->ij", share, cov + mean[:, :, None] * mean[:, None])
        np.testing.assert_allclose(second, draws.T @ draws / len(draws), atol=1e-12)


def test_a_law_of_a_few_states_has_a_part_for_each():
    states = np.array([[0.0, 1.0], [2.0, -1.0], [4.0, 0.5]])
    share, mean, cov = divided(np.repeat(states, [10, 30, 60], axis=0), 8, 0)
    order = np.argsort(mean[:, 0])
    np.testing.assert_allclose(mean[order], states)
    np.testing.assert_allclose(share[order], [0.1, 0.3, 0.6])
    np.testing.assert_allclose(cov, 0, atol=1e-15)


def evidence_of(rng, states, looks=200, hypotheses=6):
    outputs = 3 * rng.standard_normal((looks, hypotheses))
    density = 2 * rng.standard_normal((looks, hypotheses)) if states else np.zeros_like(outputs)
    return Evidence(outputs, density, rng.uniform(0.5, 2, looks))


@pytest.mark.parametrize("states", [True, False])
def test_the_loss_has_the_derivatives_that_the_fit_uses(states):
    rng = np.random.default_rng(2)
    evidence, log_prior = evidence_of(rng, states), np.log(rng.dirichlet(np.ones(6)))
    _, slope = evidence.loss(log_prior, gradient=True)
    for i in range(6):
        step = 1e-6 * np.eye(6)[i]
        up, down = (evidence.loss(log_prior + s)[0] for s in (step, -step))
        assert slope[i] == pytest.approx((up - down) / 2e-6, abs=1e-6)


def test_the_fit_finds_the_proportions_of_a_mixture():
    """Episodes of four kinds, each of which its belief alone explains."""
    proportions = np.array([0.56, 0.14, 0.24, 0.06])  # outliers in a fifth of both kinds
    kinds = np.repeat(np.arange(4), (1000 * proportions).astype(int))
    outputs = np.where(np.arange(4) == kinds[:, None], 0.0, -30.0)
    beliefs = replace_weights(np.full(4, 0.25))
    found = fit(beliefs, Evidence(outputs, np.zeros_like(outputs), np.ones(len(kinds))))
    np.testing.assert_allclose(found, proportions, atol=0.015)


def replace_weights(weight):
    count = len(weight)
    return Beliefs(
        assumed_noise=np.ones(count),
        deviation=np.zeros(count),
        outliers=np.tile([0.0, 0.1], count // 2),
        absolute=np.zeros(count, dtype=bool),
        weight=weight,
        belief=np.arange(count),
        share=np.ones(count),
        mean=np.zeros((count, 2)),
        cov=np.tile(np.eye(2), (count, 1, 1)),
    )


def test_learning_from_outputs_uses_no_true_state(monkeypatch):
    cls = TRAINERS.resolve("robust_gain")
    settings = {**QUICK["robust_gain"], "supervision": "outputs"}

    def learned():
        return train_by_name("robust_gain", cls.configured(settings), Game.of("ReverseDuffing"))

    first, look = learned(), cls._look
    monkeypatch.setattr(
        cls, "_look", lambda self, source, record, truth: look(self, source, record, 0 * truth + 7)
    )
    np.testing.assert_array_equal(first.beliefs.weight, learned().beliefs.weight)


def test_conditions_apply_to_every_system():
    for name in ("ReverseDuffing", "InductionMotor", "Satellite"):
        source = Game.of(name).source
        for seed in range(40):
            condition = draw_condition(np.random.default_rng(seed), source.system)
            condition.setup(source.system, source.setup)
            condition.plant(source.system, [np.random.default_rng(0)])


@dataclass(frozen=True)
class Escaping(System):
    """x' = 1 + x², which leaves every bound before the episode ends."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {"benchmark": Setup((-1.0,), (1.0,), duration=4.0, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        return stack(x, 1 + x[..., 0] ** 2)

    def h(self, t, x, u):
        return x


def test_a_system_whose_simulations_escape_is_refused_in_a_line():
    config = TRAINERS.resolve("robust_gain").configured(QUICK["robust_gain"])
    with pytest.raises(ValueError, match=r"^the states of Escaping leave the finite numbers .*"):
        train_by_name("robust_gain", config, Game.of(Escaping))


def test_a_budget_without_a_held_out_look_is_refused_in_a_line():
    config = TRAINERS.resolve("robust_gain").configured(QUICK["robust_gain"])
    trainer = trainer_of("robust_gain", config, Game.of("ReverseDuffing"))
    trainer.step()
    line = r"the training ended after 1 condition\(s\) \(budget=None\); expected at least 4, .*"
    with pytest.raises(ValueError, match=f"^{line}"):
        trainer.result()


def test_noise_far_from_that_of_the_training_is_told_once(caplog):
    record = Game.of(Linear).record([0])
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            estimator = bank(Linear(), (0.2,), (1.0,))
            object.__setattr__(estimator, "noise_std", 5.5)
            assert np.isfinite(estimator.run(record).xhat).all()
    (line,) = (r.getMessage() for r in caplog.records if "times that of the" in r.getMessage())
    assert line.startswith(
        "robust_gain on Linear: the noise of y1 is 55 times that of the training"
    )


def test_its_beliefs_have_names():
    names = made("robust_gain").trained.beliefs.names
    assert "model right" in names
    assert "process noise 0.1, outliers" in names
    assert "plant off by 10 %" in names
    assert "start of the training" in names


def test_it_tells_the_noise_with_which_it_used_each_sample():
    """An outlier is used with more noise, and a later model that is wrong with more process
    noise."""
    game = Game.of("ReverseDuffing")
    record = game.record([0])
    estimator = made("robust_gain")
    beliefs = estimator.trained.beliefs
    quiet = estimator.adaptation(record)
    assert quiet.output_noise.min() >= 1
    sums = quiet.beliefs.sum(axis=-1)
    np.testing.assert_allclose(sums, 1, rtol=1e-12)
    mean = np.sqrt(quiet.beliefs @ beliefs.assumed_noise**2)
    np.testing.assert_allclose(quiet.process_noise, mean, rtol=1e-12)
    y = record.y.copy()
    y[0, 500] += 2.0  # 100 standard deviations
    loud = estimator.adaptation(replace(record, y=y))
    np.testing.assert_allclose(loud.output_noise[0, :500], quiet.output_noise[0, :500], rtol=1e-9)
    assert loud.output_noise[0, 500, 0] > 10


def test_a_resumed_training_learns_the_same_and_its_file_is_loaded(tmp_path):
    config = TRAINERS.resolve("robust_gain").configured(QUICK["robust_gain"])
    game, path = Game.of("ReverseDuffing"), tmp_path / "checkpoint.pt"
    whole = train_by_name("robust_gain", config, game)
    stopped = trainer_of("robust_gain", config, game)
    stopped.step()
    stopped.step()
    save_checkpoint(stopped, path)
    resumed = train_by_name("robust_gain", config, game, checkpoint=path, resume=True)
    for field in fields(Beliefs):
        own, other = (getattr(each.beliefs, field.name) for each in (whole, resumed))
        np.testing.assert_array_equal(own, other)
    resumed.save(tmp_path / "trained.pt")
    loaded = RobustGain.load(tmp_path / "trained.pt", game.source.system)
    record = game.record([0])
    made_of = RobustGain(game.source.system, game.source.setup.noise_std, trained=whole)
    np.testing.assert_array_equal(loaded.run(record).xhat, made_of.run(record).xhat)


@pytest.mark.parametrize("plant", [Compass, Counted, Exact, NoisyPendulum])
def test_it_trains_on_other_plants_and_runs_as_it_updates(plant):
    game = Game.of(plant)
    config = TRAINERS.resolve("robust_gain").configured(QUICK["robust_gain"])
    trained = train_by_name("robust_gain", config, game)
    setup, record = game.source.setup, game.record(range(2))
    estimator = RobustGain(
        game.source.system, setup.noise_std, setup.process_noise, trained=trained
    )
    found, state = estimator.run(record), estimator.reset(record.prior)
    assert np.isfinite(found.xhat).all()
    for k, t in enumerate(record.t):
        state = estimator.update(state, float(t), record.y[:, k], record.u[:, k])
        np.testing.assert_allclose(state.xhat, found.xhat[:, k], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(state.P, found.P[:, k], rtol=1e-6, atol=1e-10)
