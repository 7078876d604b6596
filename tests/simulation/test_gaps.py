"""Gaps between samples that no number of steps would bridge are refused in one line at once."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear, linear_record
from other_motions import Counted, Exact

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.motion import MOST_STEPS
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.truth import disturbed_truth, truth

SETUP = Linear.setups["benchmark"]


@dataclass(frozen=True)
class Switched(Linear):
    def breakpoints(self):
        return (0.55,)


@dataclass(frozen=True)
class Stiff(Linear):
    stiff = True


def line(kind, end, count, longest=" of at most 0.1 s", unit=" s", start="0"):
    return re.escape(
        f"from t={start}{unit} to t={end}{unit}, {kind} would take {count} steps{longest}; "
        f"expected at most {MOST_STEPS} between two samples, with all times of one clock and in "
        "the unit of the model"
    )


@pytest.mark.parametrize("cls", [Linear, Switched, Stiff])
def test_the_model_takes_no_endless_gap(cls):
    with pytest.raises(ValueError, match=f"^{line(cls.__name__, 1000000, '1e+07')}$"):
        model_step(cls(), 0.0, 1e6, np.ones((2, 2)))
    rows = np.array([0.0, 0.0]), np.array([0.1, 1e6])
    with pytest.raises(ValueError, match=f"^{line(cls.__name__, 1000000, '1e+07')}$"):
        model_step(cls(), *rows, np.ones((2, 2)))


def test_a_map_takes_no_endless_gap_and_a_flow_of_its_own_takes_any():
    with pytest.raises(ValueError, match=f"^{line('Counted', 100000000, '1e+08', '', '')}$"):
        model_step(Counted(), 0.0, 1e8, np.ones((2, 2)))
    np.testing.assert_array_equal(model_step(Counted(), 0.0, 10.0, np.ones((1, 2))), 0.5**10)
    np.testing.assert_array_equal(model_step(Exact(), 0.0, 1e8, np.ones((2, 2))), 0.0)


@pytest.mark.parametrize("kind", [EKF, UKF])
def test_a_record_with_a_clock_jump_is_refused(kind):
    record = linear_record()
    jumped = replace(record, t=np.where(np.arange(20) < 7, record.t, record.t + 1e8))
    text = line("Linear", "100000000.7", "1e+09", start="0.6")
    with pytest.raises(ValueError, match=text):
        kind(Linear()).run(jumped)


def test_a_log_names_the_line_of_the_jump(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,y1,y2\n\n0,1,1\n0.1,1,1\n1.7e9,1,1\n1700000000.1,1,1\n")
    text = line("Linear", "1700000000", "1.7e+10", start="0.1")
    prior = Prior.of(Linear(), SETUP, 1)
    with pytest.raises(ValueError, match=f"^log {re.escape(str(path))}, line 5: {text}$"):
        read_log(path, Linear(), prior)
    jump = re.escape("t=1700000000 s after 0.1 s, as if the clock jumped; expected all times")
    with pytest.raises(ValueError, match=f"^log {re.escape(str(path))}, line 5: {jump}"):
        read_log(path, Exact(), prior)


def test_the_truth_takes_no_endless_number_of_steps():
    times, x0 = np.array([0.0, 0.5, 1e6]), np.ones((1, 2))
    text = line("Linear", "1000000", "1e+07", start="0.5")
    with pytest.raises(ValueError, match=text):
        truth(Linear(), x0, times, 0.1)
    noise = Linear().noise(0.1, 0.1)
    with pytest.raises(ValueError, match=text):
        disturbed_truth(Linear(), noise, x0, times, np.zeros((2, 1, 2, 1, 2)), 0.1)
    with pytest.raises(ValueError, match=line("Linear", "1000000", "1e+07")):
        EpisodeSource(Linear, dt=1e6, duration=2e6)
