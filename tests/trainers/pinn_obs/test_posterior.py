"""The preset posterior: a network's most probable path, its covariance, and the gain along it."""

from dataclasses import replace

import numpy as np
import pytest
from angles import TURN, Compass, north_record
from small_trainings import Interrupting, Mixer, Spring, random_record, same_weights
from small_trainings import train_pinn_obs as train

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation import smoother
from pinnobs_gym.estimation.learned.mlp import evaluate
from pinnobs_gym.estimators.pinn_obs import PinnObs, PinnObsDirect, PinnObsReplay, TrainedNetwork
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.simulation.record import Prior
from trainers.pinn_obs import PinnObsTrainer, posterior
from trainers.pinn_obs.levenberg_marquardt import stages_of
from trainers.pinn_obs.passes import unflattened
from trainers.pinn_obs.posterior_recipe import ASSUMED, PosteriorRecipe

SMALL = replace(posterior(), width=60)
LOUD = 0.5
"""Process noise of `spring_record`, in state units per √s."""


@pytest.fixture(autouse=True)
def _without_compilation(monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")  # which takes longer than these trainings


def spring_record(samples=60):
    """A noisy record of a linear plant with a measured force, at irregular times."""
    system, rng = Spring(measured_input=True), np.random.default_rng(2)
    record = random_record(system, samples)
    x, steps = np.array([1.0, 0.0]), np.diff(record.t, prepend=record.t[0])
    for k, step in enumerate(steps):
        x = x + step * system.f(0.0, x, record.u[0, k]) + LOUD * np.sqrt(step) * rng.normal(size=2)
        record.y[0, k] = x[:1] + 0.1 * rng.normal()
    record.y[0, [4, 5, 20]] = np.nan
    return system, record


def recipe_of(system, record, config=SMALL, **noise):
    return PosteriorRecipe(system, config, record, system.noise(**noise))


def test_on_a_linear_plant_it_is_the_posterior():
    """The smoother computes the same from sample to sample; the network, at a finite resolution."""
    system, record = spring_record()
    config = replace(SMALL, width=300)
    trained = train(system, config, record=record, noise_std=0.1, process_noise=LOUD)
    found, exact = trained.covariance(record.t), RTSSmoother(system, 0.1, LOUD).run(record)
    std = np.sqrt(np.einsum("kii->ki", exact.P[0]))
    assert abs((trained.xhat(record.t) - exact.xhat[0]) / std).max() < 0.1
    np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", found)) / std, 1.0, atol=0.05)
    correlation, expected = (
        P[:, 0, 1] / np.sqrt(P[:, 0, 0] * P[:, 1, 1]) for P in (found, exact.P[0])
    )
    np.testing.assert_allclose(correlation, expected, atol=0.06)


def test_of_a_linear_plant_the_squares_are_quadratic_and_one_step_finds_their_minimum():
    system, record = spring_record()
    objective = recipe_of(system, record, noise_std=0.1, process_noise=LOUD).objective
    start = objective.at_rest()
    hessian, gradient = objective.linearised(start, 0.0)
    step = np.linalg.solve(hessian, -gradient)
    least = start + step.reshape(start.shape[::-1]).T
    assert objective.loss(least) == pytest.approx(objective.loss(start) + gradient @ step, rel=1e-8)
    assert abs(objective.linearised(least, 0.0)[1]).max() < 1e-7 * abs(gradient).max()


@pytest.mark.parametrize("added", [0.0, 0.7])
def test_the_gradient_is_that_of_finite_differences(added):
    system, rng = Mixer(), np.random.default_rng(0)
    record = random_record(system, 25)
    record.y[0, [2, 5, 5], [0, 0, 1]] = np.nan
    noise = {"noise_std": [[0.3, 0.0], [0.2, 0.4]], "process_noise": np.eye(3) + 0.2}
    objective = recipe_of(system, record, replace(SMALL, width=20), **noise).objective
    here = objective.at_rest()
    here = here + 0.3 * rng.standard_normal(here.shape)
    _, gradient = objective.linearised(here, added)
    for _ in range(5):
        direction = 1e-5 * rng.standard_normal(here.shape)
        ahead, behind = (objective.loss(here + s * direction, added) for s in (1, -1))
        assert (ahead - behind) / 4 == pytest.approx(gradient @ direction.T.ravel(), rel=1e-6)


def test_the_terms_are_those_of_the_networks_path():
    """Written out for a path that was not trained, at the points by the trapezoidal rule."""
    system, record = spring_record()
    recipe = recipe_of(system, record, noise_std=0.1, process_noise=LOUD)
    objective, rng = recipe.objective, np.random.default_rng(1)
    c = objective.at_rest() + 0.1 * rng.standard_normal(objective.at_rest().shape)
    theta = objective.theta(c)
    np.testing.assert_allclose(objective.coefficients(theta), c, atol=1e-7)
    layers = unflattened(recipe.architecture, theta)

    def xhat(t):
        return evaluate(recipe.architecture, layers, t)[0]

    t, h = objective.points, 1e-6
    x, rate = xhat(t), (xhat(t + h) - xhat(t - h)) / (2 * h)
    u = np.interp(t, record.t, record.u[0, :, 0])[:, None]
    squares = ((rate - system.f(t, x, u)) ** 2).sum(1)
    Q = LOUD**2 + ASSUMED**2 / system.setups["benchmark"].duration
    initial = ((xhat(record.t[0]) - record.prior.mean[0]) ** 2).sum() / (1 + 1e-8)
    output = np.nansum((record.y[0, :, 0] - xhat(record.t)[:, 0]) ** 2) / 0.1**2
    expected = [initial, np.trapezoid(squares, t) / Q, output]
    np.testing.assert_allclose(objective.terms(theta), expected, rtol=1e-5)


def test_it_estimates_as_well_as_a_smoother_and_its_gain_replays():
    game = Game.of("Satellite")
    system, setup = game.source.system, game.source.setup
    peer = play(game, RTSSmoother(system, setup.noise_std), [0])
    trained = train(system, posterior(), record=peer.record, noise_std=setup.noise_std)
    own = play(game, PinnObsDirect(system, setup.noise_std, trained=trained), [0]).scores
    assert own.nrmse[0] < 1.1 * peer.scores.nrmse[0]
    assert own.rows()[0]["anees"] < 2
    assert trained.loss == pytest.approx(peer.record.num_samples, rel=0.2)
    replay = play(game, PinnObsReplay(system, setup.noise_std, trained=trained), [0]).scores
    assert replay.rows()[0]["nrmse_tail"] < 0.01


def test_there_is_no_smoother_in_it(monkeypatch):
    def refused(*args, **options):
        raise AssertionError("a smoother was called")

    for name in ("backward", "iterated"):
        monkeypatch.setattr(smoother, name, refused)
        monkeypatch.setattr("trainers.pinn_obs.guide.smooth", refused)
    system, record = spring_record()
    train(system, SMALL, record=record, noise_std=0.1, process_noise=LOUD)
    estimator = PinnObs(system, config=SMALL)
    assert (estimator.label, estimator.training["knows"]) == ("pinn_obs (posterior)", ("noise",))


@pytest.mark.filterwarnings("ignore:the gain of PINN-Obs on ReverseDuffing does not replay")
def test_a_resumed_training_ends_as_one_that_was_not_interrupted(tmp_path):
    game = Game.of("ReverseDuffing", duration=4.0)
    system, record, path = game.source.system, game.record([3]), tmp_path / "checkpoint.pt"
    config, options = replace(SMALL, checkpoint_every=3), {"record": record, "noise_std": 0.02}
    straight = train(system, config, **options)
    with pytest.warns(UserWarning, match="ended .* standard deviations from the most probable"):
        train(system, config, checkpoint=path, log=Interrupting(7), **options)
    resumed = train(system, config, checkpoint=path, resume=True, **options)
    assert resumed.iterations == straight.iterations > 7
    assert same_weights(resumed, straight)
    assert np.array_equal(resumed.covariance(record.t), straight.covariance(record.t))
    resumed.save(tmp_path / "trained.pt")
    again = TrainedNetwork.load(tmp_path / "trained.pt", system)
    assert np.array_equal(again.covariance(record.t), straight.covariance(record.t))
    other = {**options, "process_noise": 0.1}
    with pytest.raises(ValueError, match="process_noise"):
        train(system, config, checkpoint=path, resume=True, **other)


def test_nothing_in_it_is_random():
    system, record = spring_record()
    told = {"record": record, "noise_std": 0.1, "process_noise": LOUD}
    one, other = (train(system, replace(SMALL, seed=seed), **told) for seed in (0, 5))
    assert same_weights(one, other)


def test_a_loss_above_what_the_noise_explains_is_told():
    """Here that of outputs with ten times the noise that is told."""
    system, record = spring_record()
    with pytest.warns(UserWarning, match=r"the loss on this record of Spring .* about 57: the"):
        train(system, SMALL, record=record, noise_std=0.01, process_noise=0.01)


def test_a_prior_that_is_certain_holds_the_path():
    system, record = spring_record()
    sure = replace(record, prior=Prior(np.array([[1.0, 0.5]]), np.zeros((1, 2, 2))))
    trained = train(system, SMALL, record=sure, noise_std=0.1, process_noise=LOUD)
    np.testing.assert_allclose(trained.xhat(record.t[:1]), sure.prior.mean, atol=1e-3)
    assert np.einsum("kii->ki", trained.covariance(record.t))[0].max() < 1e-6


def test_whole_turns_of_an_angle_change_nothing():
    _, wrapped, plain = north_record(Compass())
    records = [record.rows(slice(2, 3)).first_samples(60) for record in (wrapped, plain)]
    turns = np.random.default_rng(0).integers(-2, 3, records[0].y.shape)
    records.append(replace(records[0], y=records[0].y + TURN * turns))
    found = [train(Compass(), SMALL, record=r, noise_std=0.05).xhat(r.t) for r in records]
    for each in found[1:]:
        np.testing.assert_allclose(each, found[0], atol=1e-6)


def test_stages_narrow_from_the_widest_noise_to_the_known_one():
    stages = stages_of(1.0, 0.01)
    assert (stages[0], stages[-1]) == (1.0, 0.0)
    assert list(stages) == sorted(stages, reverse=True)
    assert stages[-2] <= 0.01
    assert stages_of(1.0, 9.0) == (0.0,)


def test_settings_that_would_make_no_posterior_are_refused():
    for change, message in (
        ({"w_y": 100.0}, r"w_y=100\.0; expected 1 with levenberg_marquardt, a probability"),
        ({"depth": 2}, "depth=2; expected 1 with levenberg_marquardt"),
        ({"guide": 1.0}, r"guide=1\.0; expected 0 with levenberg_marquardt"),
        ({"activation": "relu"}, "activation='relu'; expected tanh with levenberg_marquardt"),
        ({"points": 300}, "points=300; expected 0 with levenberg_marquardt"),
    ):
        with pytest.raises(ValueError, match=message):
            PinnObsTrainer.configured({"preset": "posterior", **change})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ReverseDuffing", "HarmonicOscillator"])
def test_its_intervals_hold_the_state_as_often_as_they_say(name):
    """Ten records under process noise that is told: of the 90 % intervals 85 to 95 %."""
    game = Game.of(name, "benchmark", "process_noise1e-3")
    system, setup = game.source.system, game.source.setup
    level = tuple(1e-3 / np.sqrt(setup.dt) * np.asarray(system.scale))
    estimator = PinnObs(system, setup.noise_std, level, config=posterior())
    rows = play(game, estimator, range(10)).scores.rows()
    assert 0.85 < np.mean([row["coverage"] for row in rows]) < 0.95
    assert 0.8 < np.mean([row["anees"] for row in rows]) < 1.3
