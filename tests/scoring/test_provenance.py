"""What a score depends on, in two hashes."""

import importlib
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from copied import Copied
from edited import EDITS, FILES, write
from stored_rows import row

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.adapters import PerEpisode
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.provenance import (
    canonical,
    estimator_code,
    estimator_hash,
    game_hash,
    now,
    training_code,
)
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


@pytest.fixture
def hashes(tmp_path, monkeypatch):
    """The hashes of the game and of the estimator after an edit."""
    monkeypatch.syspath_prepend(tmp_path)

    def read(edit=None):
        write(tmp_path, edit)
        for name in FILES:
            sys.modules.pop(name.removesuffix(".py"), None)
        importlib.invalidate_caches()
        source = EpisodeSource(importlib.import_module("plant").Oscillator)
        estimator = importlib.import_module("mine").Obs.for_setup(source.system, source.setup)
        return game_hash(source), estimator_hash(estimator)

    yield read
    for name in FILES:
        sys.modules.pop(name.removesuffix(".py"), None)


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_of_code_changes_what_depends_on_it(hashes, edit):
    game, estimator = hashes()
    assert hashes() == (game, estimator)
    new_game, new_estimator = hashes(edit)
    said_only = edit in ("a comment", "a docstring")
    of_the_plant = EDITS[edit][0] == "plant.py"
    assert (new_game == game) == (not of_the_plant)
    assert (new_estimator == estimator) == said_only  # the plant is the estimator's model, too


def test_the_setup_and_the_parameters_are_part_of_the_game():
    source = EpisodeSource(ReverseDuffing)
    hashes = {
        game_hash(source),
        game_hash(EpisodeSource(ReverseDuffing, "paper")),
        game_hash(EpisodeSource(ReverseDuffing, dt=0.01)),
        game_hash(EpisodeSource(ReverseDuffing, noise_std=0.1)),
    }
    assert len(hashes) == 4
    assert game_hash(EpisodeSource(ReverseDuffing)) in hashes


def test_settings_noise_and_model_are_part_of_the_estimator():
    system = ReverseDuffing()
    estimators = [
        EKF(system),
        EKF(system, noise_std=0.1),
        EKF(system, process_noise=1e-3),
        EKF(system, assumed_noise=1e-3),
        EKF(replace(system, measured_input=True)),
    ]
    assert len({estimator_hash(each) for each in estimators}) == len(estimators)
    assert estimator_hash(EKF(system)) == estimator_hash(EKF(ReverseDuffing()))
    # The same noise in other words: that of the benchmark is 0.02, and none of the plant.
    assert estimator_hash(EKF(system)) == estimator_hash(
        EKF(system, (0.02,), [[0.0, 0.0], [0.0, 0.0]])
    )


def test_without_a_source_nothing_is_ever_the_same():
    system = ReverseDuffing()
    named, unnamed = PerEpisode(system, make=Copied), PerEpisode(system, make=lambda: Copied())
    assert estimator_hash(named) == estimator_hash(PerEpisode(system, make=Copied))
    assert estimator_hash(unnamed) != estimator_hash(unnamed)
    scope = {"__name__": "nowhere", "EKF": EKF}
    exec("class Mine(EKF): pass", scope)
    assert estimator_code(scope["Mine"]) == "unreadable"
    mine = scope["Mine"](system)
    assert estimator_hash(mine) != estimator_hash(mine)


def test_a_training_depends_on_its_trainer_and_on_its_plant():
    source = EpisodeSource(ReverseDuffing)
    own = training_code(TRAINERS.resolve("pinn_gain"), source)
    assert own == training_code(
        TRAINERS.resolve("pinn_gain"), EpisodeSource(ReverseDuffing, noise_std=0.1)
    )
    assert own != training_code(TRAINERS.resolve("kkl_pinn"), source)
    assert own != training_code(TRAINERS.resolve("pinn_gain"), EpisodeSource("Academic"))


def test_canonical_values_are_plain():
    shown = canonical({"a": np.float64(1.5), "b": (1, np.array([2.0])), "c": ReverseDuffing})
    assert shown == {"a": 1.5, "b": [1, [2.0]], "c": "ReverseDuffing"}
    endless = canonical({"a": np.float64("inf"), "b": [float("nan"), np.array([-np.inf])]})
    assert endless == {"a": "inf", "b": ["nan", ["-inf"]]}
    assert canonical(np.float32("inf")) == "inf"


def test_times_are_dates_of_rows(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0, date=now())])
    (back,) = rows.read(path)
    assert abs(datetime.fromisoformat(back["date"]) - datetime.now(UTC)) < timedelta(days=1)
