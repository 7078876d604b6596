"""Episodes that are simulated before they are played: the same as without, and few."""

import gc
import tracemalloc
from dataclasses import dataclass

import numpy as np
import pytest

from pinnobs_gym.envs import episode_buffer
from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.simulation.system import Setup, System

STEPS = 20
X0 = (0.3, -0.2)


@dataclass(frozen=True)
class Pushed(System):
    """A spring under a force that is drawn, with noise on plant and outputs."""

    state_names = ("q", "v")
    output_names = ("q", "v")
    input_names = ("force",)
    scale = (1.0, 1.0)
    model_step = 0.05
    setups = {
        "benchmark": Setup(
            (-1.0, -1.0),
            (1.0, 1.0),
            duration=STEPS * 0.05,
            dt=0.05,
            noise_std=0.1,
            process_noise=0.2,
        )
    }

    def f(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - x[..., 0]], axis=-1)

    def h(self, t, x, u):
        return x

    def draw_input(self, rng, times):
        return rng.uniform(-1, 1, (len(times), 1))


def masked(samples):
    """The observations (num_samples, 6) of samples whose missing outputs are NaN."""
    y, rest = samples[:, :2].copy(), samples[:, 2:]
    present = ~np.isnan(y)
    for k in range(len(y)):
        y[k] = np.where(present[k], y[k], y[k - 1] if k else 0.0)
    return np.concatenate([y, present, rest], axis=1)


def observed(env, k, given):
    """All observations and states of the next episode of a single env."""
    options = {"x0": X0} if k in given else None
    observation, info = env.reset(seed=5 if k == 0 else None, options=options)
    rows = [np.concatenate([observation, info["state"]])]
    for _ in range(STEPS):
        observation, *_, info = env.step(np.zeros(2))
        rows.append(np.concatenate([observation, info["state"]]))
    return np.array(rows)


@pytest.mark.parametrize("ahead", [1, 8])
@pytest.mark.parametrize("given", [(), (0, 2, 3, 9)])
def test_episodes_of_a_seed_are_the_same_however_far_ahead(monkeypatch, ahead, given):
    """The peer plays one episode after the other of the seed's stream, each alone."""
    monkeypatch.setattr(episode_buffer, "MOST_AHEAD", ahead)
    env = EstimationEnv(Pushed, condition="dropout10")
    source = EpisodeSource(Pushed, condition="dropout10")
    (stream,) = source.streams([5])
    for k in range(11):
        start = np.array([X0]) if k in given else None
        peer = source.play(source.draw([stream]), start)
        alone = np.concatenate([masked(peer.observations[:, 0]), peer.x[:, 0]], axis=1)
        np.testing.assert_array_equal(observed(env, k, given), alone)


def test_an_env_holds_few_episodes():
    """Bytes that NumPy has allocated and not freed: states and observations of eight episodes, with
    a quarter more for all the rest."""
    duration = 60.0
    first = EstimationEnv("ReverseDuffing", duration=duration)
    first.reset(seed=0)  # what is kept once for all envs
    samples = len(first.source.times)
    tracemalloc.start()
    try:
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        env = EstimationEnv("ReverseDuffing", duration=duration)
        env.reset(seed=1)
        env.reset()
        gc.collect()
        held = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert held <= 1.25 * episode_buffer.MOST_AHEAD * samples * (2 * 8 + 2 * 4)


def test_a_row_that_restarts_alone_has_its_own_inputs_in_the_record():
    envs = EstimationVectorEnv(3, Pushed)
    envs.reset(seed=5)
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    u = envs.record().u
    observed = [envs.source.inputs[:0]]
    for _ in range(STEPS - 1):
        observation, *_ = envs.step(np.zeros((3, 2)))
        observed.append(observation[:, 2])
    np.testing.assert_allclose(u[:, 1:, 0].T, observed[1:], rtol=1e-6)
