"""A game plays what the env plays."""

import pickle

import numpy as np
import pytest
from linear import Linear
from made_envs import IDS, make

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.systems.satellite import Satellite

SHORT = {"duration": 0.4}


def test_a_system_is_named_in_four_ways():
    games = [
        Game.of(given, "paper", "dropout10+noise5", dt=0.01)
        for given in (
            "Satellite",
            Satellite,
            "pinnobs/Satellite-v0",
            "pinnobs_gym.systems.satellite:Satellite",
        )
    ]
    assert all(game == games[0] for game in games)
    assert games[0].name == ("pinnobs/Satellite-v0", "paper", "noise5+dropout10")
    assert games[0].name.file_stem == "Satellite-v0-paper-noise5+dropout10"
    assert games[0].source.setup.dt == 0.01


@pytest.mark.parametrize("name", IDS)
def test_its_episodes_are_those_of_the_env_and_its_scores_the_rewards(name):
    """The env is stepped with the estimates; its states are scored by its rewards."""
    game, seeds = Game.of(name, condition="dropout30", **SHORT), [3, 7]
    played = play(game, EKF.for_setup(game.source.system, game.source.setup), seeds)
    for i, seed in enumerate(seeds):
        env = make(IDS[name], condition="dropout30", **SHORT)
        observation, info = env.reset(seed=seed)
        total, squares, held = 0.0, [], np.zeros(played.system.ny)
        for k, xhat in enumerate(played.estimates.xhat[i]):
            # In a batch of another size products round differently.
            np.testing.assert_allclose(info["state"], played.truth[i, k], rtol=1e-12, atol=1e-12)
            y = played.record.y[i, k]
            seen, mask = observation[: len(y)], observation[len(y) : 2 * len(y)]
            np.testing.assert_array_equal(mask == 0, np.isnan(y))
            held = np.where(np.isnan(y), held, y)
            np.testing.assert_allclose(seen, held, rtol=1e-6, atol=1e-7)
            errors = ((xhat - info["state"]) / played.system.scale) ** 2
            observation, reward, _, over, info = env.step(xhat)
            total += reward
            squares.append(errors)
        assert over
        assert total == pytest.approx(-np.mean(squares, axis=1).sum(), rel=1e-9)
        scored = played.system.observable(played.truth[i])  # errors no output tells of are not
        mean_square = np.mean(np.array(squares)[scored])
        np.testing.assert_allclose(played.scores.nrmse[i], np.sqrt(mean_square), rtol=1e-9)


def test_its_record_is_that_of_the_vectorised_env():
    game = Game.of("InductionMotor", condition="load_step", **SHORT)
    env = game.vector_env(3)
    env.reset(seed=5)
    own, peer = game.record(range(5, 8)), env.record()
    for name in ("t", "y", "u"):
        np.testing.assert_array_equal(getattr(own, name), getattr(peer, name))
    np.testing.assert_array_equal(own.prior.mean, peer.prior.mean)


def test_initial_states_may_be_given_and_then_there_is_no_reference():
    game = Game.of(Linear)
    x0 = np.array([[0.5, -0.5], [0.1, 0.2]])
    assert np.array_equal(game.episodes([0, 1], x0).x[0], x0)
    ekf = EKF.for_setup(game.source.system, game.source.setup)
    assert play(game, ekf, [0, 1]).reference is not None
    assert play(game, ekf, [0, 1], x0).reference is None
    assert play(Game.of(Linear, noise_std=0.3), ekf, [0, 1]).scores.reference_steady is None


def test_it_can_be_pickled():
    game = Game.of("Academic", condition="mismatch10", **SHORT)
    again = pickle.loads(pickle.dumps(game))
    assert again == game
    np.testing.assert_array_equal(again.record([4]).y, game.record([4]).y)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Nothing",), "unknown system 'Nothing'; known are"),
        (("pinnobs/Nothing-v0",), "unknown env id 'pinnobs/Nothing-v0'; known are pinnobs/"),
        (("Academic", "nowhere"), "unknown setup 'nowhere' of Academic"),
        (("Academic", "paper", "fog"), "unknown condition 'fog'"),
        (("Academic", "benchmark", "load_step"), "needs a plant with a load torque"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(arguments, message):
    with pytest.raises(ValueError, match=message):
        Game.of(*arguments)


def test_estimates_of_the_wrong_shape_are_refused():
    class Short(EKF):
        def run(self, record):
            estimates = super().run(record)
            return type(estimates)(estimates.xhat[:, 1:])

    game = Game.of("Academic", **SHORT)
    with pytest.raises(ValueError, match=r"Short\.run returned xhat of shape \(1, 19, 2\); exp"):
        play(game, Short.for_setup(game.source.system, game.source.setup), [0])
