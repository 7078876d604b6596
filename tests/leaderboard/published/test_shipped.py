"""The results that ship with the package are whole."""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

import pinnobs_gym
from pinnobs_gym.leaderboard import published
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.packing import LARGEST
from pinnobs_gym.leaderboard.published.reading import published_floors, rows_in
from pinnobs_gym.systems import SYSTEMS

FOLDER = Path(published.__file__).parent


@pytest.fixture
def shipped(monkeypatch):
    monkeypatch.setattr("pinnobs_gym.leaderboard.published.manifest.FOLDER", FOLDER)
    found = Manifest.read(FOLDER)
    assert found is not None
    return found


def test_every_file_is_the_one_that_was_published(shipped):
    files = [*shipped.rows, *shipped.trained, *shipped.curves]
    for entry in files:
        data = (FOLDER / entry.file).read_bytes()
        assert len(data) == entry.size
        if not entry.file.endswith(".npz"):
            assert shipped.content(entry)
    assert sum(entry.size for entry in files) <= LARGEST
    assert {entry.game.env_id for entry in shipped.rows} == {
        f"pinnobs/{name}-v0" for name in SYSTEMS.sources
    }


def test_rows_of_a_game_and_its_floor_are_read(shipped):
    (game,) = {
        e.game
        for e in shipped.rows
        if e.floor and e.game[0] == "pinnobs/Academic-v0" and e.game.condition == "nominal"
    }
    floor = published_floors([game])
    assert {row["track"] for row in floor} == {"floor", "floor, whole"}
    assert min(row["effective_sample_size"] for row in floor) >= 500
    (entry,) = [each for each in shipped.rows if each.game == game and not each.floor]
    found = rows_in(shipped, [entry])
    assert len(found) == entry.rows


def test_every_learned_estimator_has_all_trainings_that_the_guide_says_in_every_game(shipped):
    """Those trained on single records have one."""
    seeds = set(shipped.training_seeds)
    word = {3: "three", 5: "five"}[len(seeds)]
    guide = FOLDER.parents[2] / "docs" / "guides" / "published.md"
    if guide.exists():  # not beside an installed package
        assert f"\n{word} trainings of each learned one" in guide.read_text(encoding="utf-8")
    for entry in shipped.rows:
        found = defaultdict(set)
        for row in rows_in(shipped, [entry]):
            if row.get("training_seed") is not None:
                found[row["estimator"]].add(row["training_seed"])
        on_record = {name for name in found if name.startswith("pinn_obs (")}
        assert all(found[name] == {shipped.training_seeds[0]} for name in on_record)
        assert all(found[name] == seeds for name in found.keys() - on_record)
        assert entry.floor or len(found.keys() - on_record) > 4


def test_a_trained_estimator_is_loaded_by_name(shipped):
    estimator = pinnobs_gym.load("kkl_pinn", "Academic")
    (row,) = pinnobs_gym.evaluate(estimator, "Academic", episodes=1)
    assert row["training_seed"] == 0
    assert np.isfinite(row["nrmse_steady"])
    assert row["nrmse_steady"] < 0.1
