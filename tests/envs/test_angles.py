"""States that are angles: rewards, scores, curves and pictures do not count whole turns."""

from dataclasses import replace

import numpy as np
import pytest
from angles import TURN, Compass, north_record
from matplotlib.backends.backend_agg import FigureCanvasAgg

from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.figures import EpisodePicture, measured_states, state_figure
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.curves import curves_of
from pinnobs_gym.scoring.metrics import score
from pinnobs_gym.scoring.playing import play

SETUP = Compass.setups["benchmark"]
HALF = np.array([TURN / 2, 0.0])
"""Half a turn."""


def test_rewards_are_of_the_angle():
    """The squared error over the scale, of an estimate two turns off and one degree ahead."""
    ahead = np.radians(1.0)
    expected = -((ahead / 3.0) ** 2) / 2
    env = EstimationEnv(Compass)
    _, info = env.reset(seed=0)
    _, reward, *_ = env.step(info["state"] + [2 * TURN + ahead, 0.0])
    assert reward == pytest.approx(expected, rel=1e-9)
    envs = EstimationVectorEnv(2, Compass)
    _, infos = envs.reset(seed=0)
    _, rewards, *_ = envs.step(infos["state"] + [[-TURN + ahead, 0.0], [ahead, 0.0]])
    np.testing.assert_allclose(rewards, expected, rtol=1e-9)


def test_scores_do_not_count_whole_turns():
    heading, record, _ = north_record(Compass())
    x = np.stack([heading, np.gradient(heading, record.t, axis=1)], axis=-1)
    run = EKF.for_setup(Compass(), SETUP).run(record)
    turns = np.random.default_rng(0).integers(-2, 3, heading.shape)
    other = replace(run, xhat=run.xhat + TURN * turns[..., None] * [1.0, 0.0])
    near, far = (score(Compass(), record, x, e, 5.0) for e in (run, other))
    assert not near.diverged.any()
    for own, found in zip(near.rows(), far.rows(), strict=True):
        by_window, expected = (each.pop("state_rmse") for each in (found, own))
        for window, errors in expected.items():
            assert by_window[window] == pytest.approx(errors, rel=1e-9)
        known = {name: value for name, value in own.items() if value is not None}
        assert {"rmse", "smape", "settling", "anees", "coverage", "nis"} <= set(known)
        assert {name: found[name] for name in known} == pytest.approx(known, rel=1e-9)


def test_an_estimate_half_a_turn_off_has_half_a_turn_as_its_error():
    heading, record, _ = north_record(Compass())
    x = np.stack([heading, np.zeros_like(heading)], axis=-1)
    found = score(Compass(), record, x, Estimates(x + 5 * HALF), 5.0)
    np.testing.assert_allclose(found.mae, TURN / 4)
    np.testing.assert_allclose(found.nrmse, TURN / 2 / 3.0 / np.sqrt(2))


def test_curves_are_of_the_angle():
    game = Game.of(Compass)
    played = play(game, EKF.for_setup(Compass(), SETUP), [0, 1])
    moved = played.estimates.xhat + 6 * HALF
    far = replace(played, estimates=replace(played.estimates, xhat=moved))
    near, found = curves_of(played), curves_of(far)
    np.testing.assert_allclose(found.error, near.error, rtol=1e-3)
    np.testing.assert_allclose(found.example.xhat, near.example.xhat, rtol=1e-5)
    off = found.example.y - found.example.x[:, :1]
    assert (abs(off) < 6 * 0.05).all()  # six standard deviations of the noise


@pytest.mark.parametrize("known", [True, False])
def test_a_figure_has_no_jumps_and_dots_beside_the_heading(known):
    heading, record, _ = north_record(Compass())
    x = np.stack([heading, np.gradient(heading, record.t, axis=1)], axis=-1)[2]
    run = EKF.for_setup(Compass(), SETUP).run(record)
    shown = {"x": x} if known else {}
    figure = state_figure(Compass(), record.t, run.xhat[2], y=record.y[2], P=run.P[2], **shown)
    FigureCanvasAgg(figure).draw()
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    assert measured_states(Compass()) == {0: 0}
    np.testing.assert_allclose(lines["measured"], heading[2], atol=0.3)
    np.testing.assert_allclose(lines["estimate"], heading[2], atol=0.3)


def test_a_figure_has_a_gap_where_the_estimate_passes_the_opposite():
    """An estimate that stands still while the heading makes two turns passes it twice."""
    heading, record, _ = north_record(Compass())
    x = np.stack([heading, np.gradient(heading, record.t, axis=1)], axis=-1)[2]
    xhat, P = np.tile([3.0, 0.0], (len(x), 1)), np.tile(np.eye(2), (len(x), 1, 1))
    figure = state_figure(Compass(), record.t, xhat, x=x, P=P)
    FigureCanvasAgg(figure).draw()
    (line,) = (line for line in figure.axes[0].lines if line.get_label() == "estimate")
    y = np.asarray(line.get_ydata())
    assert np.isnan(y).sum() == 2
    np.testing.assert_allclose(np.unique(np.round(y[~np.isnan(y)] - 3.0, 9)), [0, TURN, 2 * TURN])


@pytest.mark.parametrize("known", [True, False])
def test_lines_of_a_wrapped_heading_have_gaps(known):
    """True states and estimates from −π to π, as those of a map may be, through which the heading
    turns twice; one that counts turns has no gap, however fast it is."""
    heading, record, _ = north_record(Compass())
    x = np.stack([np.angle(np.exp(1j * heading[2])), np.zeros(len(record.t))], axis=-1)
    xhat = x + np.array([1e-3, 0.0])
    shown = {"x": x} if known else {}
    figure = state_figure(Compass(), record.t, xhat, **shown)
    for line in figure.axes[0].lines:
        y = np.asarray(line.get_ydata())
        crossed = int((abs(np.diff(x[:, 0])) > TURN / 2).sum())
        assert np.isnan(y).sum() == crossed == 2
        assert np.nanmax(abs(np.diff(y))) < 0.1
    fast = np.stack([3.5 * np.arange(50.0), np.zeros(50)], axis=-1)
    shown = {"x": fast} if known else {}
    figure = state_figure(Compass(), record.t[:50], fast, **shown)
    for line in figure.axes[0].lines:
        assert not np.isnan(np.asarray(line.get_ydata())).any()


def test_frames_draw_the_angle_nearest_to_the_heading():
    """The curves of the last frame, of an estimate half a degree ahead and some turns off."""
    heading, record, _ = north_record(Compass())
    x = np.stack([heading, np.gradient(heading, record.t, axis=1)], axis=-1)[2]
    picture = EpisodePicture(Compass(), "rgb_array")
    picture.begin(record.t, x, np.concatenate([record.y[2], record.t[:, None]], axis=-1))
    for k in range(len(x)):
        picture.add(k, x[k] + np.radians(0.5) + 2 * (k % 5 - 2) * HALF)
    assert picture.draw(len(x) - 1) is not None
    panel, drawn = picture._canvas.figure.axes[0], {}
    for line in panel.lines:
        drawn[line.get_label()] = np.asarray(line.get_ydata())
    np.testing.assert_allclose(drawn["estimate"], heading[2] + np.radians(0.5))
    np.testing.assert_allclose(drawn["measured"], heading[2], atol=0.3)
