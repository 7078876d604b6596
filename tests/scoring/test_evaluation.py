from dataclasses import dataclass, replace

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pinnobs_gym import evaluate
from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.adapters import PerEpisode
from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring import rows
from pinnobs_gym.systems.academic import Academic
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.training.log import Log

ENV = "pinnobs/ReverseDuffing-v0"


class Lazy(Estimator):
    """Always x̂₀."""

    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        return State(state.xhat, t=t)


class Exploding(Lazy):
    """Not finite in one row after a while."""

    def update(self, state, t, y, u):
        xhat = state.xhat.copy()
        if t > 0.5:
            xhat[0] = np.nan
        return State(xhat, t=t)


def test_scores_are_those_of_the_single_env_played_by_hand():
    scored = evaluate(Lazy(ReverseDuffing()), ENV, episodes=3, seed=5)
    for i, row in enumerate(scored):
        env = EstimationEnv("ReverseDuffing")
        _, info = env.reset(seed=5 + i)
        square, rewards, over = 0.0, 0.0, False
        while not over:
            square += (info["state"] ** 2).mean()  # the prior's mean is zero
            _, reward, _, over, info = env.step(np.zeros(2))
            rewards += reward
        assert row["mse"] == pytest.approx(square / 1000, rel=1e-12)
        assert row["nrmse"] ** 2 == pytest.approx(-rewards / 1000, rel=1e-12)
        assert row["episode"] == f"seed:{5 + i}"


def test_a_row_that_is_not_finite_diverges_alone():
    scored = evaluate(Exploding(ReverseDuffing()), ENV, episodes=2)
    assert scored[0]["diverged"]
    assert np.isinf(scored[0]["nrmse"])
    other = evaluate(Lazy(ReverseDuffing()), ENV, episodes=2)
    assert scored[1]["nrmse"] == other[1]["nrmse"]


def test_instance_class_and_name_give_the_same_scores():
    by_name = evaluate("ekf", ENV, episodes=2)
    by_class = evaluate(EKF, ENV, episodes=2)
    by_instance = evaluate(EKF(ReverseDuffing(), noise_std=0.02), ENV, episodes=2)
    for other in (by_class, by_instance):
        assert [r["nrmse"] for r in other] == [r["nrmse"] for r in by_name]
        assert [r["estimator_hash"] for r in other] == [r["estimator_hash"] for r in by_name]


def test_options_are_settings_and_part_of_the_identity():
    default = evaluate("ekf", ENV, episodes=1)
    tuned = evaluate("ekf", ENV, episodes=1, options={"assumed_noise": 0.3})
    assert tuned[0]["estimator_hash"] != default[0]["estimator_hash"]
    assert tuned[0]["nrmse"] != default[0]["nrmse"]
    assert tuned[0]["options"]["assumed_noise"] == 0.3


def test_resuming_runs_only_what_is_missing(tmp_path):
    path = tmp_path / "rows.jsonl"
    ran = []
    first = evaluate("ekf", ENV, episodes=3, results=path, progress=ran.append)
    again = evaluate("ekf", ENV, episodes=5, results=path, progress=ran.append)
    assert ran == [3, 2]
    straight = evaluate("ekf", ENV, episodes=5)
    assert [r["nrmse"] for r in again] == pytest.approx([r["nrmse"] for r in straight], rel=1e-12)
    assert again[:3] == first
    assert len(rows.read(path)) == 5


def test_conditions_are_played_and_told():
    quiet = evaluate("ukf", ENV, episodes=20, condition="noise5")
    loud = evaluate("ukf", ENV, episodes=20, condition="noise15")
    ratio = np.median([a["nrmse_tail"] / b["nrmse_tail"] for a, b in zip(loud, quiet, strict=True)])
    assert 2 < ratio < 4  # errors in proportion to the noise, which is three times as strong


def test_the_satellite_is_also_scored_modulo_its_sign():
    class Mirrored(Lazy):
        name = "mirrored"

        def reset(self, prior):
            return State(prior.mean * [1, -1, -1])

    from pinnobs_gym.systems.satellite import Satellite

    wrong = Mirrored(Satellite())
    (row,) = evaluate(wrong, "pinnobs/Satellite-v0", episodes=1)
    assert row["nrmse_modulo"] < row["nrmse"]


def test_tensorboard_has_scalars_a_figure_and_hparams(tmp_path):
    with Log(tmp_path) as log:
        scored = evaluate("ekf", ENV, episodes=3, seed=7, log=log)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    nrmse = events.Scalars("episode/nrmse")
    assert [event.step for event in nrmse] == [7, 8, 9]
    assert [event.value for event in nrmse] == pytest.approx([r["nrmse"] for r in scored], rel=1e-6)
    assert events.Images("states")
    assert events.Scalars("median/nrmse")
    assert "_hparams_/session_start_info" in events.summary_metadata


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ({"env_id": "pinnobs/Nothing-v0"}, "unknown env id 'pinnobs/Nothing-v0'; known are pinn"),
        ({"env_id": "CartPole-v1"}, "unknown system 'CartPole-v1'; known are Academic"),
        ({"estimator": "kf"}, "unknown estimator 'kf'; known are .*, ekf, "),
        ({"setup": "hard"}, "unknown setup 'hard' of ReverseDuffing; it has benchmark, paper"),
        ({"condition": "rain"}, "unknown condition 'rain'; known are nominal"),
        ({"condition": "load_step"}, "needs a plant with a load torque; ReverseDuffing has none"),
        ({"episodes": 0}, "episodes=0; expected at least 1"),
        ({"episodes": -3}, "episodes=-3; expected at least 1"),
        ({"episodes": 1.5}, "episodes=1.5; expected a whole number"),
        ({"seed": -1}, "seed=-1; expected at least 0"),
        ({"estimator": PerEpisode(ReverseDuffing(), make=list, title=" mine")}, 'estimator=" mine'),
        ({"options": {"gain": 1.0}}, "^setting 'gain'; expected one of assumed_noise, gate, "),
        (
            {"options": {"process_noise": 1e-3}},
            "^setting 'process_noise'; expected one of assumed_noise, gate, huber, patience$",
        ),
        (
            {"estimator": "open_loop", "options": {"noise_std": 0.1}},
            "^setting 'noise_std'; expected no settings$",
        ),
        (
            {"estimator": EKF(Academic())},
            "model is Academic .*; that of the game is ReverseDuffing",
        ),
        ({"estimator": "pinn_obs_replay"}, "has to be trained first: pinnobs train pinn_obs"),
    ],
)
def test_bad_input_is_one_clear_line(call, message):
    arguments = {"estimator": "ekf", "env_id": ENV, "episodes": 1, **call}
    with pytest.raises(ValueError, match=message) as caught:
        evaluate(arguments.pop("estimator"), arguments.pop("env_id"), **arguments)
    assert "\n" not in str(caught.value)


def test_the_reference_is_that_of_the_same_episodes():
    """Least squares of noisy records without process noise attain it: errors at the last sample,
    where smoother and filter are one, are as large as it says."""
    ratios = [
        row["nrmse_steady"] / row["reference_steady"]
        for row in evaluate("mhe", "pinnobs/Academic-v0", episodes=60, options={"window": 60})
    ]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1, abs=0.25)


def per_duration(system, per_sample):
    """Return the standard deviation that process noise reaches over an episode: variances add."""
    setup = system.setups["benchmark"]
    return per_sample * np.sqrt(setup.duration / setup.dt)


def test_the_reference_knows_of_noise_gaps_and_process_noise():
    """More noise, missing outputs and a disturbed state leave a filter that knows of it as near to
    the reference as it was; one whose condition is not in the model has none."""
    for condition, options in (
        ("noise5", {}),
        ("dropout50", {}),
        ("process_noise1e-3", {"assumed_noise": per_duration(Academic, 1e-3)}),
    ):
        scored = evaluate(
            "ekf", "pinnobs/Academic-v0", episodes=40, condition=condition, options=options
        )
        squares = [
            np.sum([r[n] ** 2 for r in scored]) for n in ("nrmse_steady", "reference_steady")
        ]
        assert np.sqrt(squares[0] / squares[1]) == pytest.approx(1, abs=0.25), condition
    (row,) = evaluate("ekf", "pinnobs/Academic-v0", episodes=1, condition="mismatch10")
    assert row["reference_steady"] is None
    (row,) = evaluate("ekf", "pinnobs/Academic-v0", episodes=1, setup="paper")
    assert row["reference_steady"] is None


@dataclass(frozen=True)
class LateMotor(InductionMotor):
    """The motor with a steady window that is its last quarter."""

    setups = {"benchmark": replace(InductionMotor.setups["benchmark"], transient=0.75)}


def test_a_reference_below_the_error_of_a_step_is_none():
    """The motor forgets its past: without process noise the reference of its tail is 1e-8."""
    (row,) = evaluate("ekf", Game.of(LateMotor).system, episodes=1)
    assert row["reference_steady"] is None
    known = {
        "condition": "process_noise1e-3",
        "options": {"assumed_noise": per_duration(LateMotor, 1e-3)},
    }
    (row,) = evaluate("ekf", Game.of(LateMotor).system, episodes=1, **known)
    assert row["nrmse_steady"] / row["reference_steady"] == pytest.approx(1, abs=0.4)
