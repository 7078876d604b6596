"""Forms of actions and observations: what they mean, in single and vectorised envs."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from linear import Linear
from made_envs import ALLOWED_WARNINGS, DUFFING, IDS, MOTOR, make, make_vec, short

from pinnobs_gym.envs.actions import FORMS, OUTSIDE, Gain, PredictionForm, form_of, typical
from pinnobs_gym.envs.arguments import NOT_FINITE_REWARD
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.systems import SYSTEMS

OTHERS = [name for name in FORMS if name != "estimate"]  # which test_env has


@pytest.mark.parametrize("name", IDS.values())
@pytest.mark.parametrize("mode", OTHERS)
@pytest.mark.parametrize("checker", ["gymnasium", "stable_baselines3"])
def test_conforms(name: str, mode: str, checker: str) -> None:
    env = make(name, action_mode=mode).unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if checker == "gymnasium":
            check_env(env, skip_render_check=True)
        else:
            from stable_baselines3.common.env_checker import check_env as check_sb3

            check_sb3(env, skip_render_check=True)
    messages = [str(warning.message) for warning in caught]
    assert not [m for m in messages if not any(allowed in m for allowed in ALLOWED_WARNINGS[:2])]


@pytest.mark.parametrize("name", IDS)
def test_spaces(name: str) -> None:
    system = SYSTEMS.resolve(name)()
    nx, ny, nu = system.nx, system.ny, system.nu
    sizes = {
        "normalized": (nx, ny + nu + 1),
        "gain": (nx * ny, ny + nx + nu + 1),
        "correction": (nx, ny + nx + nu + 1),
    }
    assert set(sizes) == set(OTHERS)
    for mode, (actions, features) in sizes.items():
        env = make(IDS[name], action_mode=mode)
        assert env.action_space == gymnasium.spaces.Box(-1, 1, (actions,), np.float32)
        assert env.observation_space.shape == (features,)
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        assert env.step(env.action_space.sample())[0] in env.observation_space


# What actions mean


@pytest.mark.parametrize("name", ["ReverseDuffing", "InductionMotor"])
def test_gain_is_the_observer_written_out(name: str) -> None:
    """With L = ρ·σ(k)/√S(k) the env scores x̂ = x̂⁻ + L(y − h(x̂⁻)), whatever ρ."""
    env, raw = make(IDS[name], action_mode="gain"), make(IDS[name])
    system, setup = raw.unwrapped.source.system, raw.unwrapped.source.setup
    sigma, root_S = typical(system, setup)
    observation, info = env.reset(seed=5)
    sample, _ = raw.reset(seed=5)
    rng = np.random.default_rng(0)
    xhat = info["xhat0"]
    for k in range(30):
        if k:
            xhat = model_step(system, setup.times[k - 1], setup.times[k], xhat[None])[0]
        y = sample[: system.ny].astype(float)
        e = y - system.h(setup.times[k], xhat, raw.unwrapped.source.inputs[k])
        scale = np.array(system.scale)
        assert observation[: system.ny] == pytest.approx(np.arcsinh(e / root_S[k]), rel=1e-5)
        middle = observation[system.ny : system.ny + system.nx]
        assert middle == pytest.approx(xhat / scale, rel=1e-5, abs=1e-6)
        last = np.log1p(k) / np.log1p(setup.num_steps)
        assert observation[-1] == pytest.approx(last, abs=1e-6)
        rho = rng.uniform(-0.3, 0.3, (system.nx, system.ny))
        xhat = xhat + (sigma[k][:, None] * rho / root_S[k]) @ e
        xhat = np.clip(xhat, -2 * np.array(system.state_bound), 2 * np.array(system.state_bound))
        error = (xhat - info["state"]) / scale
        observation, reward, *_, info = env.step(rho.ravel())
        sample = raw.step(xhat)[0]
        assert reward == pytest.approx(-np.mean(error**2), rel=1e-9)


def test_no_gain_is_the_model_alone() -> None:
    env = make(MOTOR, action_mode="gain")
    system = env.unwrapped.source.system
    _, info = env.reset(seed=0)
    x, xhat = info["state"], info["xhat0"]
    for k in range(20):
        error = (xhat - x) / np.array(system.scale)
        _, reward, *_, info = env.step(np.zeros(10))
        assert reward == pytest.approx(-np.mean(error**2), rel=1e-9)
        x, xhat = info["state"], model_step(system, k * 1e-3, (k + 1) * 1e-3, xhat[None])[0]


def test_a_correction_adds_three_typical_errors() -> None:
    env = make(DUFFING, action_mode="correction")
    sigma, _ = typical(env.unwrapped.source.system, env.unwrapped.source.setup)
    _, info = env.reset(seed=0)
    xhat = info["xhat0"] + 3 * sigma[0] * [0.1, -0.2]
    error = (xhat - info["state"]) / np.array([1.3, 1.0])
    assert env.step(np.array([0.1, -0.2]))[1] == pytest.approx(-np.mean(error**2), rel=1e-9)


def test_normalized_estimate() -> None:
    env = make(DUFFING, action_mode="normalized")
    _, info = env.reset(seed=0)
    assert env.step(info["state"] / [2.3, 1.9])[1] == pytest.approx(0, abs=1e-12)


def test_typical_errors_of_a_linear_plant_are_kalmans() -> None:
    """There the covariance is the same along every trajectory."""
    system, setup = Linear.configured()
    sigma, root_S = typical(system, setup)
    t = setup.times[:30]
    zeros = np.zeros((1, len(t), system.ny))
    prior = Prior.of(system, setup, 1)
    record = Record(t, zeros, np.zeros((1, len(t), system.nu)), prior)
    estimates = EKF.for_setup(system, setup).run(record)
    assert estimates.S is not None
    found = np.sqrt(np.einsum("tii->ti", estimates.S[0]))
    np.testing.assert_allclose(root_S[:30], found, rtol=1e-9)
    assert estimates.P is not None
    after = np.einsum("tii->ti", estimates.P[0])
    assert (sigma[:30] ** 2 >= after * (1 - 1e-9)).all()  # predictions are worse than estimates
    np.testing.assert_allclose(sigma[0], np.sqrt(np.diag(setup.P0)), rtol=1e-9)


def test_kalman_gains_are_actions() -> None:
    """On a linear plant Kalman's gain is an action in [−1, 1], and gives his estimates."""
    system, setup = Linear.configured()
    form = Gain(system, setup)
    rng = np.random.default_rng(0)
    t = setup.times[:20]
    y = rng.standard_normal((2, len(t), system.ny))
    prior = Prior.of(system, setup, 2)
    u = np.zeros((2, len(t), system.nu))
    ekf = EKF.for_setup(system, setup)
    expected = ekf.run(Record(t, y, u, prior))
    assert expected.innovation is not None
    memory = form.begin(prior.mean, np.zeros(2), u[:, 0])
    for k in range(len(t)):
        _, memory = form.observe(memory, np.full(2, t[k]), y[:, k], u[:, k])
        # the gain from two episodes' corrections, solved for: nx·ny unknowns, ny = 2 episodes
        added = (expected.xhat[:, k] - memory.xhat).T
        K = np.linalg.solve(expected.innovation[:, k], added.T).T
        rho = K * form.root_S[k] / form.sigma[k][:, None]
        assert (abs(rho) <= 1 + 1e-6).all()
        memory = form.act(memory, np.tile(rho.ravel(), (2, 1)))
        np.testing.assert_allclose(memory.xhat, expected.xhat[:, k], rtol=1e-8, atol=1e-10)


def test_a_missing_output_corrects_nothing() -> None:
    form = form_of("gain", *SYSTEMS.resolve("ReverseDuffing").configured())
    one = np.zeros(1)
    memory = form.begin(np.array([[1.0, 1.0]]), one, np.zeros((1, 0)))
    features, memory = form.observe(memory, one, np.array([[np.nan]]), np.zeros((1, 0)))
    assert np.isfinite(features).all()
    assert form.act(memory, np.ones((1, 2))).xhat.tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize("condition", ["dropout50", "delay3", "gap", "noise5+dropout10"])
@pytest.mark.parametrize("mode", FORMS)
def test_observations_stay_in_their_space_where_outputs_are_missing(
    mode: str, condition: str
) -> None:
    env = make(MOTOR, action_mode=mode, condition=condition)
    actions = np.zeros(env.action_space.shape)
    seen = [env.reset(seed=0)[0], *(env.step(actions)[0] for _ in range(300))]
    assert np.isfinite(seen).all()
    assert all(env.observation_space.contains(each) for each in seen)


@pytest.mark.parametrize("mode", ["estimate", "normalized"])
@pytest.mark.parametrize("stack", [1, 3])
def test_a_missing_output_is_the_latest_one_and_masked(mode: str, stack: int) -> None:
    """Written out by hand from the record, sample by sample."""
    arguments = {"condition": "dropout50", "duration": 0.05}
    env = make(MOTOR, action_mode=mode, stack_outputs=stack, **arguments)
    envs = make_vec(MOTOR, 2, action_mode=mode, stack_outputs=stack, **arguments)
    y = Game.of("InductionMotor", **arguments).record([7]).y[0]
    assert np.isnan(y).any(axis=0).all()
    space, masks = env.observation_space, slice(2 * stack, 4 * stack)
    assert space.low[masks].tolist() == [0] * 2 * stack
    assert space.high[masks].tolist() == [1] * 2 * stack
    observation, row = env.reset(seed=7)[0], envs.reset(seed=6)[0][1]
    held = np.zeros((len(y) + stack, 2))  # zero before the first
    for k, sample in enumerate(y):
        for i in range(2):
            held[k + stack, i] = held[k + stack - 1, i] if np.isnan(sample[i]) else sample[i]
        present = np.zeros((stack, 2))
        for back in range(min(stack, k + 1)):
            present[back] = ~np.isnan(y[k - back])
        latest = held[k + 1 : k + stack + 1][::-1]
        np.testing.assert_allclose(observation[: 2 * stack], latest.ravel(), rtol=1e-6)
        assert observation[masks].tolist() == present.ravel().tolist()
        np.testing.assert_array_equal(row, observation)
        action = np.zeros(env.action_space.shape)
        observation = env.step(action)[0]
        row = envs.step(np.zeros((2, *action.shape)))[0][1]


def test_estimates_stay_in_bounds() -> None:
    env = make(DUFFING, action_mode="gain")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    bound = OUTSIDE * np.array([2.3, 1.9]) / [1.3, 1.0]
    for _ in range(300):
        observation, reward, terminated, _, _ = env.step(1e6 * rng.standard_normal(2))
        assert np.isfinite(observation).all()
        assert not terminated
        assert reward > -np.mean((2 * bound) ** 2)


# Reward


def test_improvement() -> None:
    """It is zero for a gain of zero, positive for the better of two and negative for the worse."""
    env = make(DUFFING, action_mode="gain", reward="improvement")
    _, info = env.reset(seed=3)
    sigma, _ = typical(env.unwrapped.source.system, env.unwrapped.source.setup)
    assert env.step(np.zeros(2))[1] == 0
    observation, info = env.reset(seed=3)
    before = info["xhat0"] - info["state"]
    nis = np.sinh(observation[0]) ** 2
    after = before + np.array([0.5 * sigma[0][0] * np.sinh(observation[0]), 0])
    expected = np.mean((before**2 - after**2) / sigma[0] ** 2) / (1 + nis)
    assert env.step(np.array([0.5, 0.0]))[1] == pytest.approx(expected, rel=1e-5)
    assert expected > 0
    env.reset(seed=3)
    assert env.step(np.array([-0.5, 0.0]))[1] < 0


# The same everywhere


@pytest.mark.parametrize("mode", [*OTHERS, "estimate"])
@pytest.mark.parametrize("name", ["Satellite", "InductionMotor"])
def test_row_of_vector_env_is_the_single_env(name: str, mode: str) -> None:
    """Over three episodes whose rows begin together."""
    learns = issubclass(FORMS[mode], PredictionForm)
    arguments: dict[str, Any] = {"reward": "improvement"} if learns else {"stack_outputs": 3}
    arguments |= {"action_mode": mode}
    envs = make_vec(IDS[name], 2, **short(name), **arguments)
    singles = [make(IDS[name], **short(name), **arguments) for _ in range(2)]
    rng = np.random.default_rng(0)
    actions = np.zeros((2, *singles[0].action_space.shape))
    for episode, k in itertools.product(range(3), range(13)):
        if k == 0:
            alone = [
                env.reset(seed=7 + i if not episode else None)[0] for i, env in enumerate(singles)
            ]
            observations = envs.step(actions)[0] if episode else envs.reset(seed=7)[0]
        for i in range(2):
            np.testing.assert_allclose(observations[i], alone[i], rtol=1e-5, atol=1e-6)
        actions = rng.uniform(-1, 1, actions.shape)
        if k == 12:
            break
        observations, rewards, _, truncated, _ = envs.step(actions)
        for i, env in enumerate(singles):
            alone[i], reward, _, over, _ = env.step(actions[i])
            assert reward == pytest.approx(rewards[i], rel=1e-7, abs=1e-9)
            assert isinstance(reward, float)
            assert over == truncated[i] == (k == 11)


def test_rows_reset_alone() -> None:
    """A mask of rows leaves what the others observe as it is; a lost row begins anew."""
    envs = make_vec(DUFFING, 3, action_mode="gain")
    twin = make_vec(DUFFING, 3, action_mode="gain")
    for env in (envs, twin):
        before = env.reset(seed=0)[0]
    actions = np.full((3, 2), 0.2)
    before, after = envs.step(actions)[0], twin.step(actions)[0]
    mask = np.array([False, True, False])
    again, infos = envs.reset(options={"reset_mask": mask})
    assert np.array_equal(again[~mask], before[~mask])
    expected = infos["xhat0"][1] / [1.3, 1.0]
    assert again[1, 1:3] == pytest.approx(expected)
    following, after = envs.step(actions)[0], twin.step(actions)[0]
    assert np.array_equal(following[~mask], after[~mask])
    actions[0] = np.nan
    _, rewards, terminated, _, _ = envs.step(actions)
    assert rewards[0] == NOT_FINITE_REWARD
    assert terminated.tolist() == [True, False, False]
    observations = envs.step(np.zeros((3, 2)))[0]
    assert observations[0, 1:3] == pytest.approx(expected)
    assert observations[0, -1] == 0


def test_stacked_outputs() -> None:
    env, raw = make(DUFFING, stack_outputs=3), make(DUFFING)
    first, plain = env.reset(seed=0)[0], raw.reset(seed=0)[0]
    assert first.tolist() == [plain[0], 0, 0, 0]
    seen = [plain[0]]
    for _ in range(4):
        observation, plain = env.step(np.zeros(2))[0], raw.step(np.zeros(2))[0]
        seen.insert(0, plain[0])
        assert observation[:3].tolist() == [*seen, 0, 0][:3]
        assert observation[3] == plain[1]


# Bad input


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"action_mode": "gains"}, "unknown action_mode 'gains'; known are estimate, normalized"),
        ({"reward": "log"}, "reward='log'; expected 'error' or 'improvement'"),
        ({"reward": "improvement"}, "needs a prediction; 'estimate' has none"),
        ({"action_mode": "gain", "stack_outputs": 2}, "stack=2 goes with estimates"),
        ({"stack_outputs": 0}, "stack_outputs=0; expected a whole number from 1 to 1001"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], says: str) -> None:
    for build in (lambda: make(DUFFING, **arguments), lambda: make_vec(DUFFING, 2, **arguments)):
        with pytest.raises(ValueError, match=says):
            build()


@pytest.mark.parametrize("mode", FORMS)
def test_action_of_the_wrong_shape(mode: str) -> None:
    env, envs = make(DUFFING, action_mode=mode), make_vec(DUFFING, 3, action_mode=mode)
    env.reset(seed=0)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(5,\).*\(2,\)"):
        env.unwrapped.step(np.zeros(5))
    with pytest.raises(ValueError, match=r"shape \(3, 5\).*\(3, 2\)"):
        envs.step(np.zeros((3, 5)))
