"""The page model: computed once, complete without the rows it was made from."""

import shutil

import pytest
from made_rows import rows_of
from page_rows import curves

from pinnobs_gym.leaderboard import places, standings
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.site.model import page_model
from pinnobs_gym.leaderboard.site.page import draw
from pinnobs_gym.scoring.curves import save
from pinnobs_gym.scoring.rows import Stored

COMMON = {"date": "2030-01-02T00:00:00", "versions": {"numpy": "2"}}
MOTOR = {"env_id": "pinnobs/Motor-v0", **COMMON}
FAILURE = {"env_id": "pinnobs/Motor-v0", "setup": "benchmark", "condition": "nominal"}
FAILURE |= {"estimator": "broken", "episode": "seed:0", "episodes": 4, "error": "no luck"}


def scored():
    """Two systems, one of them ranked under another condition than nominal; two training seeds."""
    rows = [row for name in ("ekf", "ukf") for row in rows_of(name, [0.1, 0.2], **COMMON)]
    rows += rows_of("smooth", [0.05, 0.1], track="offline", **COMMON)
    for name in ("ekf", "ukf"):
        for condition in ("nominal", "load_step", "noise5"):
            ranked = condition == "load_step"
            rows += rows_of(name, [0.1, 0.3], condition=condition, ranked=ranked, **MOTOR)
    for seed in (0, 1):
        made = {"training": {"seed": seed}, "training_seed": seed, "estimator_hash": f"gain{seed}"}
        rows += rows_of("gain", [0.2, 0.1], **COMMON, **made)
    return rows


@pytest.fixture
def counted(monkeypatch):
    """How often each interval is computed from rows."""
    calls = dict.fromkeys(("median", "rate", "score"), 0)

    def count(module, name):
        original = getattr(module, name)

        def counting(*arguments):
            calls[name] += 1
            return original(*arguments)

        monkeypatch.setattr(module, name, counting)

    count(standings, "median")
    count(standings, "rate")
    count(places, "score")
    return calls


GAMES = 4 + 3 * 2
"""Lines of the tables of games: X, and the motor under three conditions."""
OVERVIEW = 4
CONDITIONS = 3 + 2 + 2
"""Online estimators under nominal, load_step and noise5, over all systems."""
BY_SYSTEM = 3 + 3 * 2
"""The same on X and on the motor by themselves."""
PEERS = 4 + 1 + 3
"""Lines of the peer, whose factor is 1, in games, overview and conditions."""
PEERS_BY_SYSTEM = 1 + 3
"""The same under the conditions of X and of the motor."""
# Both training seeds of the gain together are a line of its game and one of the overview; other
# lines of the overview are those of a game.
STANDINGS = {"median": 3 * (GAMES + 1), "rate": GAMES + 1}


def lines(part):
    return sum(len(table.entries) for table in part.tables)


def test_the_page_computes_an_interval_once_per_cell(counted):
    page = page_model(Stored(scored(), []), [])
    tables = [each.table for section in page.sections for each in section.games]
    assert [len(table.entries) for table in tables] == [2, 2, 4]  # the motor's two, and X
    assert (lines(page.main), len(page.main.lines), page.on_record) == (GAMES, OVERVIEW, None)
    # A factor in each of two windows.
    scores = GAMES + OVERVIEW + CONDITIONS + BY_SYSTEM - PEERS - PEERS_BY_SYSTEM
    assert counted == {**STANDINGS, "score": 2 * scores}


def test_the_board_computes_an_interval_once_per_cell(counted):
    found = board(Stored(scored(), []))
    assert (lines(found.main), len(found.main.lines)) == (GAMES, OVERVIEW)
    assert counted == {**STANDINGS, "score": 2 * (GAMES + OVERVIEW + CONDITIONS - PEERS)}


def test_drawing_needs_neither_rows_nor_curves(tmp_path, counted):
    def made():
        return Stored(scored(), [dict(FAILURE)])

    for row in (made().rows[0], made().rows[2]):
        save(tmp_path, row, curves([[0.1, 0.2, 0.3]]))
    whole = draw(page_model(made(), [tmp_path]))
    assert '"errors2"' in whole
    assert "no luck" in whole
    stored = made()
    page = page_model(stored, [tmp_path])
    for row in (*stored.rows, *stored.failures):
        row.clear()
    stored.rows.clear()
    shutil.rmtree(tmp_path)
    before = dict(counted)
    assert draw(page) == whole
    assert counted == before


def test_a_contender_has_one_name_in_all_sections():
    """Other settings have fewer rows in all, but more under the condition that is ranked."""
    gated = {"options": {"gate": 0.9}, "settings": {"gate": 0.9}, "estimator_hash": "gated"}
    rows = rows_of("ekf", [0.1] * 4, condition="noise5", ranked=False, **COMMON)
    rows += rows_of("ekf", [0.1], **COMMON)
    rows += rows_of("ekf", [0.2, 0.2], **gated, **COMMON)
    page = page_model(Stored(rows, []), [])
    gate = "ekf (gate=0.9)"
    assert {line.estimator for line in page.main.lines} == set(page.tracks) == {"ekf", gate}
    medians = {
        line.estimator: [s.steady.value for s in line.games.values()] for line in page.main.lines
    }
    assert medians == {"ekf": [0.1], gate: [0.2]}
