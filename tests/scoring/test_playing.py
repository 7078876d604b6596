"""The cost of a step, measured by a clock that only the estimators here advance."""

from dataclasses import dataclass

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimates, Estimator, OfflineEstimator, State
from pinnobs_gym.scoring import playing
from pinnobs_gym.scoring.playing import play

STEP = 3e-6
"""Seconds of a step of one episode."""


@dataclass(frozen=True)
class Preparing(Estimator):
    """Takes a second at the first sample of the first record, and another at its second sample."""

    spent: list = None
    prepared: set = None

    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        sample = "first" if state.t is None else "later"
        self.spent[0] += len(y) * STEP + (0.0 if sample in self.prepared else 1.0)
        self.prepared.add(sample)
        return State(state.xhat, t=t)


@pytest.fixture
def clock(monkeypatch):
    spent = [0.0]
    monkeypatch.setattr(playing.time, "process_time", lambda: spent[0])
    return spent


@pytest.mark.parametrize("episodes", [1, 5])
def test_what_is_prepared_once_is_no_part_of_the_cost_of_a_step(clock, episodes):
    game, estimator = Game.of(Linear), Preparing(Linear(), spent=clock, prepared=set())
    for _ in range(2):
        before = clock[0]
        played = play(game, estimator, range(episodes))
        assert played.us_per_step == pytest.approx(1e6 * STEP)
    # The second time nothing but the record itself is run.
    assert clock[0] - before == pytest.approx(episodes * played.record.num_samples * STEP)


def test_each_estimator_is_prepared(clock):
    game = Game.of(Linear)
    for _ in range(3):
        estimator = Preparing(Linear(), spent=clock, prepared=set())
        assert play(game, estimator, [0]).us_per_step == pytest.approx(1e6 * STEP)


@dataclass(frozen=True)
class Counting(OfflineEstimator):
    """Counts its runs."""

    runs: list = None

    def run(self, record):
        self.runs.append(record.num_samples)
        return Estimates(np.repeat(record.prior.mean[:, None], record.num_samples, axis=1))


@pytest.mark.parametrize("trained", [False, True])
def test_estimators_of_whole_records_run_once(monkeypatch, trained):
    """One that is online, but trained on the record, would be trained twice."""
    if trained:
        monkeypatch.setattr(Counting, "track", "online")
        monkeypatch.setattr(Counting, "trains_on_record", "pinn_obs")
    estimator = Counting(Linear(), runs=[])
    played = play(Game.of(Linear), estimator, [0, 1])
    assert estimator.runs == [played.record.num_samples]


@dataclass(frozen=True)
class Needing(Counting):
    """Needs more than two samples, although it is online."""

    track = "online"

    def run(self, record):
        if record.num_samples < 3:
            raise ValueError("expected 3 samples")
        return super().run(record)


def test_an_estimator_that_needs_more_samples_is_played():
    estimator = Needing(Linear(), runs=[])
    played = play(Game.of(Linear), estimator, [0])
    assert estimator.runs == [played.record.num_samples]
