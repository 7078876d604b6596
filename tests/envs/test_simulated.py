"""`simulate` and `plot`, and how objects are shown."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear
from made_envs import IDS, make

import pinnobs_gym
from pinnobs_gym import Record, evaluate, plot, simulate
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.shown import html
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


@pytest.mark.parametrize("spec", ["InductionMotor", "pinnobs/InductionMotor-v0", InductionMotor])
def test_simulated_episodes_are_those_of_the_env(spec):
    record, truth = simulate(spec, 4, episodes=2, duration=0.02)
    assert record.system == InductionMotor()
    for row in range(2):
        env = make(IDS["InductionMotor"], duration=0.02)
        observation, info = env.reset(seed=4 + row)
        for k in range(record.num_samples):
            np.testing.assert_allclose(observation[:2], record.y[row, k], rtol=1e-6)
            np.testing.assert_allclose(info["state"], truth[row, k], rtol=1e-12)
            observation, *_, info = env.step(info["state"])


def test_it_takes_conditions_and_names_of_what_is_wrong():
    record, _ = simulate("ReverseDuffing", condition="dropout50")
    assert 0.4 < np.isnan(record.y).mean() < 0.6
    with pytest.raises(ValueError, match="did you mean 'ReverseDuffing'"):
        simulate("ReverseDufing")


def test_a_plot_has_the_estimates_the_truth_and_the_errors():
    record, truth = simulate("ReverseDuffing", 3, episodes=2)
    estimates = EKF(record.system).run(record)
    figure = plot(record, estimates, truth, episode=1, title="mine")
    *states, errors = figure.axes
    assert [panel.get_ylabel() for panel in states] == ["x1", "x2"]
    lines = {str(line.get_label()): line.get_ydata() for line in states[1].lines}
    np.testing.assert_allclose(lines["true"], truth[1, :, 1])
    np.testing.assert_allclose(lines["estimate"], estimates.xhat[1, :, 1])
    drawn = errors.lines[1].get_ydata()
    np.testing.assert_allclose(drawn, abs(estimates.xhat - truth)[1, :, 1] / 1.0)
    assert errors.get_yscale() == "log"
    assert len(plot(record, estimates.xhat).axes) == 2  # without truth no errors


def test_a_plot_tells_what_is_wrong():
    record, truth = simulate("ReverseDuffing")
    plain = Record(record.t, record.y, record.u, record.prior)
    with pytest.raises(ValueError, match="does not know its system"):
        plot(plain, truth)
    assert len(plot(plain, truth, truth, system=ReverseDuffing()).axes) == 3
    with pytest.raises(ValueError, match=r"truth have shape \(1, 1000\); expected \(1, 1000, 2\)"):
        plot(record, truth, truth[..., 0])
    with pytest.raises(ValueError, match="episode=1; the record has 1"):
        plot(record, truth, episode=1)


@dataclass(frozen=True)
class Marked(Linear):
    """A system <of> markup."""

    gain: float = 2.0


def test_objects_are_shown_in_one_line_that_makes_them():
    assert repr(ReverseDuffing()) == "ReverseDuffing()"
    assert repr(Marked(gain=3.0)) == "Marked(gain=3.0)"
    ekf = EKF(ReverseDuffing(), 0.1, patience=3)
    assert repr(ekf) == "EKF(ReverseDuffing(), noise_std=0.1, patience=3)"
    assert eval(repr(ekf)) == ekf
    for cls in SYSTEMS.classes().values():
        assert repr(cls()) == f"{cls.__name__}()"
    for cls in ESTIMATORS.classes().values():
        if not cls.needs_training:
            text = repr(cls(ReverseDuffing()))
            assert text.startswith(f"{cls.__name__}(ReverseDuffing()")
            assert len(text) < 200
    record, _ = simulate("ReverseDuffing", condition="dropout10")
    assert re.fullmatch(
        r"SimulatedRecord\(1 episode, 1000 samples from t=0 to [\d.]+, ny=1, nu=0, "
        r"\d+ % of the outputs missing\)",
        repr(record),
    )


def test_html_shows_names_and_no_markup_of_theirs():
    assert html("<a>", "<b>", ("<c>",), [("<d>",)]).count("<") == 13  # of the tags alone
    shown = Marked()._repr_html_()
    assert "A system &lt;of&gt; markup." in shown
    assert "<td>x1</td><td>state</td>" in ReverseDuffing()._repr_html_()
    assert "<td>patience</td><td>15</td>" in EKF(ReverseDuffing())._repr_html_()
    record, _ = simulate("ReverseDuffing", condition="dropout10")
    known = int((~np.isnan(record.y)).sum())
    assert f"<td>{known}</td>" in record._repr_html_()
    empty = replace(record, y=np.full_like(record.y, np.nan))
    assert "<td>0</td>" in empty._repr_html_()


def test_everything_public_is_listed_and_there():
    assert set(pinnobs_gym.__all__) <= set(dir(pinnobs_gym))
    for name in pinnobs_gym.__all__:
        assert getattr(pinnobs_gym, name) is not None


def test_evaluate_shows_its_progress(monkeypatch, capsys):
    monkeypatch.setattr("pinnobs_gym.training.progress.EVERY", 0.0)
    evaluate("ekf", "Academic", episodes=3, progress=True)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("0 of 3 episodes, simulating: 0 % after")
    assert any("estimating" in line for line in lines)
    assert lines[-1].startswith("3 of 3 episodes: 100 % after")
    counted = []
    evaluate("ekf", "Academic", episodes=3, progress=counted.append)
    assert counted == [3]
    assert capsys.readouterr().out == ""
