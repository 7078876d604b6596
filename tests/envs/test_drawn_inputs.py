"""Inputs that are drawn for each episode, against closed forms and the same plant without them."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.cramer_rao import cramer_rao
from pinnobs_gym.simulation.augmented import Unknown, augmented
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.systems.satellite import Satellite

DT = 0.2


@dataclass(frozen=True)
class Tank(System):
    """A level that follows its inflow."""

    rate: float = 1.5
    state_names = ("level",)
    output_names = ("y",)
    input_names = ("inflow",)
    scale = (1.0,)
    model_step = DT
    setups = {"benchmark": Setup((0.0,), (1.0,), duration=4.0, dt=DT, noise_std=0.05)}

    def f(self, t, x, u):
        return -np.reshape(self.rate, (-1, 1)) * x + u

    def h(self, t, x, u):
        return x + 0.1 * u

    def f_jacobian(self, t, x, u):
        return np.full((*x.shape, 1), -1.0) * np.reshape(self.rate, (-1, 1, 1))

    def h_jacobian(self, t, x, u):
        return np.ones((*x.shape, 1))


class Driven(Tank):
    def draw_input(self, rng, times):
        return rng.uniform(-1, 1, (len(times), 1))


class Joined(Driven):
    input_hold = "linear"


def played(cls, batch=4, **options):
    source = EpisodeSource(cls, **options)
    return source, source.play(source.draw(source.streams(range(batch))))


def exact(cls, x0, u, rate=1.5):
    """States at the samples: x⁺ = ax + (1 − a)u/r for a held input, and for the part of a joined
    one that grows by s, s((1 − (1 − a)/(r dt))/r."""
    a, x = np.exp(-rate * DT), [x0]
    for now, then in itertools.pairwise(u):
        slope = (then - now) if cls.input_hold == "linear" else 0.0
        x.append(a * x[-1] + (1 - a) * now / rate + slope * (1 - (1 - a) / (rate * DT)) / rate)
    return np.array(x)


@pytest.mark.parametrize("cls", [Driven, Joined])
def test_the_plant_moves_as_its_inputs_say_between_samples(cls):
    _, episodes = played(cls)
    np.testing.assert_allclose(
        episodes.x, exact(cls, episodes.x[0], episodes.u), rtol=0, atol=1e-11
    )
    assert len(np.unique(episodes.u)) == episodes.u.size
    assert episodes.u.shape == (21, 4, 1)


@pytest.mark.parametrize("cls", [Driven, Joined])
def test_estimators_are_told_them_and_their_model_moves_alike(cls):
    """The Kalman filter of the Runge-Kutta step, written out."""
    source, episodes = played(cls)
    record = source.record(episodes)
    np.testing.assert_array_equal(record.u, episodes.u[:-1].swapaxes(0, 1))
    found = EKF(source.system, 0.05, assumed_noise=0.0).run(record)
    z = -1.5 * DT
    step = lambda x, u0, um, u1: (  # noqa: E731
        x * (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
        + DT * ((u0 + 4 * um + u1) / 6 + z * (u0 + 2 * um) / 6 + z**2 * (u0 + um) / 12)
        + DT * z**3 * u0 / 24
    )
    xhat, P = record.prior.mean[:, 0], record.prior.cov[0, 0, 0]
    for k in range(record.num_samples):
        if k:
            u0, u1 = record.u[:, k - 1, 0], record.u[:, k, 0]
            u1 = u1 if cls is Joined else u0
            xhat = step(xhat, u0, (u0 + u1) / 2, u1)
            P = P * (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24) ** 2
        K = P / (P + 0.05**2)
        xhat = xhat + K * (record.y[:, k, 0] - xhat - 0.1 * record.u[:, k, 0])
        P = (1 - K) * P
        np.testing.assert_allclose(found.xhat[:, k, 0], xhat, rtol=0, atol=1e-12)


def test_initial_states_and_noise_do_not_change():
    plain, drawn = EpisodeSource(Tank), EpisodeSource(Driven)
    draws = [source.draw(plain.streams(range(5))) for source in (plain, drawn)]
    np.testing.assert_array_equal(draws[0].x0, draws[1].x0)
    np.testing.assert_array_equal(draws[0].noise, draws[1].noise)


def test_an_episode_has_its_input_in_any_batch_and_the_next_has_another():
    source, episodes = played(Driven)
    for seed in range(4):
        streams = source.streams([seed])
        alone = source.play(source.draw(streams))
        np.testing.assert_array_equal(alone.x[:, 0], episodes.x[:, seed])
        np.testing.assert_array_equal(alone.u[:, 0], episodes.u[:, seed])
        assert not np.array_equal(source.play(source.draw(streams)).u, alone.u)


def test_with_plants_that_differ_and_with_process_noise():
    source, episodes = played(Driven, condition="mismatch10")
    plant = source.condition.plant(
        source.system,
        [np.random.default_rng(s) for s in source.draw(source.streams(range(4))).seeds],
    )
    rates = np.asarray(plant.rate)[:, None]
    assert np.ptp(rates) > 0.01
    expected = exact(Driven, episodes.x[0], episodes.u, rates)
    np.testing.assert_allclose(episodes.x, expected, rtol=0, atol=1e-11)

    class Noisy(Driven):
        setups = {"benchmark": replace(Tank.setups["benchmark"], process_noise=1e-9)}

    _, noisy = played(Noisy)
    still = exact(Driven, noisy.x[0], noisy.u)
    np.testing.assert_allclose(noisy.x, still, rtol=0, atol=1e-7)


def test_an_env_observes_them():
    """Without corrections, the estimates of an agent are the model's from the prior mean."""
    _, episodes = played(Driven)
    np.testing.assert_array_equal(episodes.observations[..., 1:2], episodes.u.astype(np.float32))
    env = EstimationEnv(Driven, action_mode="correction")
    act, xhat = env.agent.act, []
    env.agent.act = lambda actions: xhat.append(act(actions)[0, 0]) or act(actions)
    env.reset(seed=3)
    for _ in range(4):
        env.step(np.zeros(env.action_space.shape, np.float32))
    expected = exact(Driven, np.array([[0.5]]), episodes.u[:4, 3:4])[:, 0, 0]
    np.testing.assert_allclose(xhat, expected, rtol=0, atol=1e-4)  # by the Runge-Kutta step


def test_they_are_drawn_for_the_plant_with_further_states():
    plant = Driven()
    further = augmented(plant, disturbance={plant.state_names[0]: Unknown(0.0, 0.1)})
    assert further.draws_input
    drawn = [
        each.draw_input(np.random.default_rng(1), np.arange(21.0)) for each in (plant, further)
    ]
    assert np.array_equal(*drawn)
    fixed = augmented(Satellite(), disturbance={"x1": Unknown(0.0, 0.1)})
    assert not fixed.draws_input


def test_the_reference_is_linearised_with_them():
    """Of a plant whose output is proportional to its input: P⁻¹ gains u²/R at each sample."""

    class Scaled(Driven):
        def f(self, t, x, u):
            return 0.0 * x

        def f_jacobian(self, t, x, u):
            return np.zeros((*x.shape, 1))

        def h(self, t, x, u):
            return x * u

        def h_jacobian(self, t, x, u):
            return np.broadcast_to(u[..., None], (*x.shape, 1))

    source, episodes = played(Scaled)
    record, x = source.record(episodes), episodes.x[:-1].swapaxes(0, 1)
    P = cramer_rao(source.system, record.t, x, np.eye(1), source.noise, u=record.u)[..., 0, 0]
    expected = 1 / (1 + np.cumsum(record.u[..., 0] ** 2, axis=1) / 0.05**2)
    np.testing.assert_allclose(P, expected, rtol=1e-9)


@pytest.mark.parametrize(
    "value", [np.zeros((3, 1)), np.full((21, 1), np.nan), np.full((21, 1), "a")]
)
def test_what_is_no_input_is_refused(value):
    class Wrong(Driven):
        def draw_input(self, rng, times):
            return value

    with pytest.raises(TypeError, match=r"Wrong.draw_input .* expected finite numbers"):
        played(Wrong)
