"""The page model: computed once, complete without the rows it was made from."""

import shutil

import pytest
from made_rows import rows_of
from page_rows import curves

from pinnobs_gym.leaderboard import ranks, standings
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
    calls = dict.fromkeys(("median", "rate", "bootstrapped"), 0)

    def count(module, name):
        original = getattr(module, name)

        def counting(*arguments):
            calls[name] += 1
            return original(*arguments)

        monkeypatch.setattr(module, name, counting)

    count(standings, "median")
    count(standings, "rate")
    count(ranks, "bootstrapped")
    return calls


def test_the_page_computes_an_interval_once_per_cell(counted):
    page = page_model(Stored(scored(), []), [])
    tables = [each.table for section in page.sections for each in section.games]
    assert [len(table.standings) for table in tables] == [2, 2, 5]  # the motor's two, and X
    lines = sum(len(table.standings) for table in tables)
    # Both training seeds of the gain together are one more cell, of the overview.
    assert counted == {"median": 3 * (lines + 1), "rate": lines + 1, "bootstrapped": 2 * 4}
    assert len(page.lines) == 4


def test_the_board_computes_an_interval_once_per_cell(counted):
    found = board(Stored(scored(), []))
    lines = sum(len(table.standings) for table in found.tables)
    assert lines == 2 + 3 + 2 * 3
    assert counted == {"median": 3 * (lines + 1), "rate": lines + 1, "bootstrapped": 2 * 4}


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
    gated = {"options": {"gate": 0.9}, "estimator_hash": "gated"}
    rows = rows_of("ekf", [0.1] * 4, condition="noise5", ranked=False, **COMMON)
    rows += rows_of("ekf", [0.1], **COMMON)
    rows += rows_of("ekf", [0.2, 0.2], **gated, **COMMON)
    page = page_model(Stored(rows, []), [])
    gate = "ekf (gate=0.9)"
    assert {line.estimator for line in page.lines} == set(page.tracks) == {"ekf", gate}
    medians = {line.estimator: [s.nrmse.value for s in line.games.values()] for line in page.lines}
    assert medians == {"ekf": [0.1], gate: [0.2]}
