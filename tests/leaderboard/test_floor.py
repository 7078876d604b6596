"""Floors of errors: never a contender, and ratios against ones worked out by hand or simulated."""

import numpy as np
import pytest
from made_rows import rows_of

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard import floor, ranks_table, standings_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import chapters
from pinnobs_gym.leaderboard.floor import Floor, over_floor
from pinnobs_gym.leaderboard.grid import fitting
from pinnobs_gym.scoring.row_format import FLOOR, FLOOR_WHOLE
from pinnobs_gym.scoring.rows import Stored

GAME = GameName("pinnobs/X-v0", "benchmark", "nominal")
OTHER = {"env_id": "pinnobs/Y-v0"}


def exact(nrmse, track=FLOOR, **changes):
    name = "exact_bayes" if track == FLOOR else "exact_bayes_smoother"
    facts = {"effective_sample_size": 900.0, "knows": ["law"], **changes}
    return rows_of(name, nrmse, track=track, **facts)


def main_of(rows, shipped=()):
    return board(Stored(rows, []), shipped).main


def floor_of(rows):
    return Floor({row["episode"]: row for row in rows})


def ratio_of(errors, floors, **changes):
    return over_floor({"": (rows_of("ekf", errors, **changes), floor_of(exact(floors)))}, "steady")


def test_the_ratio_is_that_of_root_mean_squares_with_its_interval():
    """Of e² = 9, 16, ... over f² = 1, 4, ..., each of five episodes: √5. The interval is that of
    the jackknife, by leaving out each episode, with the degrees of freedom of as many episodes as
    weigh equally: parts of 0.056 and 0.144 weigh as 1/(5·0.056² + 5·0.144²) = 8.4 of them."""
    found = ratio_of([3.0, 4.0] * 5, [1.0, 2.0] * 5)
    e, f = np.array([9.0, 16.0] * 5), np.array([1.0, 4.0] * 5)
    without = [np.log(np.delete(e, i).mean() / np.delete(f, i).mean()) / 2 for i in range(10)]
    error = np.sqrt(np.sum((without - np.mean(without)) ** 2) * 8 / 7)
    expected = np.sqrt(5) * np.exp(np.array([0, -1, 1]) * 2.364624 * error)  # t of 7 degrees
    assert [found.value, found.low, found.high] == pytest.approx(expected, rel=1e-6)


def test_each_window_has_its_own_ratio():
    rows = rows_of("ukf", [3.0, 4.0] * 5)
    for row in rows:
        row |= {"nrmse_transient": 2 * row["nrmse"], "nrmse_steady": 77.0}
    (table,) = main_of([*rows, *exact([1.0, 2.0] * 5)]).tables
    standing = table.entries[0].standing
    assert standing.over_floor_steady.value == pytest.approx(5**0.5)
    assert standing.over_floor_transient.value == pytest.approx(20**0.5)
    assert standings_table.grid(table).only(["/ Bayes", "transient / Bayes"]).lines[0] == (
        *("2.24 (1.9–2.6)", "4.47 (3.9–5.2)"),
    )


def test_only_episodes_count_that_both_have_and_ten_at_least():
    errors = [3.0, 4.0] * 5 + [50.0] * 3
    assert ratio_of(errors, [1.0, 2.0] * 5).value == pytest.approx(5**0.5)
    assert ratio_of([0.1] * 9, [0.1] * 20) is None
    assert ratio_of([0.1] * 20, [0.0] * 20) is None
    lost = [np.inf] * 11 + [0.1] * 9
    assert ratio_of([0.1] * 20, lost) is None  # a floor that is not finite is none


def test_a_diverged_episode_counts_with_its_error():
    lost = [False] * 9 + [True]
    found = ratio_of([3.0, 4.0] * 4 + [3.0, 40.0], [1.0, 2.0] * 5, diverged=lost)
    assert found.value == pytest.approx(np.sqrt((5 * 9 + 4 * 16 + 1600) / 25))
    found = ratio_of([3.0] * 9 + [np.inf], [1.0] * 10, diverged=lost)
    assert standings_table.over_floor_text(found, standings_table.interval_text) == "∞"


def test_an_estimate_as_good_as_the_floor_has_the_ratio_one():
    found = ratio_of([0.1, 0.3] * 5, [0.1, 0.3] * 5)
    assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)
    assert ratio_of([0.0] * 10, [0.1] * 10).value == pytest.approx(1e-11)


def test_trainings_are_a_level_of_their_own():
    """Two trainings with errors of 1 and 3 on every episode, floor 1: mean square 5, influence ∓0.4
    of whole trainings. Their variance is 0.32/2, and the interval that of one degree of freedom."""
    rows = []
    for seed, error in enumerate((1.0, 3.0)):
        made = {"training": {"seconds": 1.0}, "training_seed": seed, "estimator_hash": f"{seed}"}
        rows += rows_of("gain", [error] * 12, **made)
    found = over_floor({"": (rows, floor_of(exact([1.0] * 12)))}, "steady")
    half = 12.7062 * np.sqrt(0.32 / 2)
    expected = np.sqrt(5) * np.exp([0.0, -half, half])
    assert [found.value, found.low, found.high] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("width", [0.7, 1.5])
@pytest.mark.parametrize(("seeds", "spread"), [(1, 0.0), (3, 0.2), (5, 0.2)])
def test_intervals_cover_the_ratio(seeds, spread, width):
    """Squared floors and squared errors over them are lognormal, with effects of trainings: the
    ratio of means is known. With a wide law a few episodes are most of the mean."""
    rng, noise, repetitions = np.random.default_rng(seeds), 0.6, 200
    truth = 1.2 * np.exp((noise**2 + spread**2) / 4)
    covered = 0
    for _ in range(repetitions):
        least = width * rng.standard_normal(50)
        logs = spread * rng.standard_normal((seeds, 1)) + noise * rng.standard_normal((seeds, 50))
        errors = 1.2 * np.exp((least + logs) / 2)
        rows = [
            {"training_seed": s, "episode": f"{k}", "nrmse_steady_modulo": errors[s, k]}
            for s in range(seeds)
            for k in range(50)
        ]
        below = {
            f"{k}": {"episode": f"{k}", "nrmse_steady": value, "nrmse_steady_modulo": value}
            for k, value in enumerate(np.exp(least / 2))
        }
        found = over_floor({"": (rows, Floor(below))}, "steady")
        covered += found.low <= truth <= found.high
    assert covered >= 0.9 * repetitions


def contenders():
    rng = np.random.default_rng(0)
    rows = []
    for facts in ({}, OTHER):
        for name, size in (("ukf", 1.0), ("ekf", 1.3), ("gain", 2.0)):
            rows += rows_of(name, size * np.exp(0.1 * rng.standard_normal(60)) / 50, **facts)
        rows += rows_of("smooth", np.exp(rng.standard_normal(60)) / 99, track="offline", **facts)
    return rows


def floors_of_contenders():
    return [
        row
        for facts in ({}, OTHER)
        for row in (*exact([0.015] * 90, **facts), *exact([0.005] * 90, FLOOR_WHOLE, **facts))
    ]


def test_a_floor_changes_no_rank_no_peer_and_no_tie():
    alone, found = main_of(contenders()), main_of([*floors_of_contenders(), *contenders()])
    assert found.places == alone.places
    assert found.conditions == alone.conditions
    assert [line.estimator for line in found.lines] == [line.estimator for line in alone.lines]
    assert [each.name for each in found.contenders] == [each.name for each in alone.contenders]
    for table, other in zip(found.tables, alone.tables, strict=True):
        assert [(e.name, e.ranks) for e in table.entries] == [
            (e.name, e.ranks) for e in other.entries
        ]
        assert [e.name for e in table.floor] == ["exact_bayes", "exact_bayes_smoother"]
        assert [e.standing.episodes for e in table.floor] == [60, 60]  # those that were played


def test_floors_stand_in_a_block_of_their_own():
    grid = standings_table.grid(main_of([*contenders(), *floors_of_contenders()]).tables[0])
    names = [line[1] for line in grid.lines]
    assert names[-3:] == ["smooth", "exact_bayes", "exact_bayes_smoother"]
    assert grid.blocks == (3, 4)  # before the offline ones, and before the floor
    assert [line[0] for line in grid.lines[-2:]] == ["", ""]
    assert grid.note == "Floor: exact Bayes, with at least 900 effective draws."


def test_online_estimators_are_compared_with_the_filtered_floor_and_others_with_the_smoothed():
    made = [*rows_of("ukf", [0.4] * 10), *rows_of("rts", [0.4] * 10, track="offline")]
    made += rows_of("told", [0.4] * 10, track="online, condition known")
    table = main_of([*made, *exact([0.2] * 10)]).tables[0]
    ratios = {e.name: e.standing.over_floor_steady for e in table.entries}
    assert (ratios["ukf"].value, ratios["told"].value) == (pytest.approx(2), pytest.approx(2))
    assert ratios["rts"] is None
    table = main_of([*made, *exact([0.1] * 10, FLOOR_WHOLE)]).tables[0]
    ratios = {e.name: e.standing.over_floor_steady for e in table.entries}
    assert (ratios["ukf"], ratios["rts"].value) == (None, pytest.approx(4))


def test_below_one_beyond_the_interval_is_marked():
    made = [*rows_of("ukf", [0.1, 0.11] * 10), *exact([0.2, 0.21] * 10)]
    table = main_of(made).tables[0]
    cell = standings_table.grid(table).only(["/ Bayes"]).lines[0][0]
    assert cell.startswith("0.513 (")
    assert cell.endswith(") ▼")


def test_a_floor_of_other_code_is_left_out_with_a_note():
    shipped = exact([0.1] * 12, game_hash="another")
    found = board(Stored(rows_of("ukf", [0.2] * 12), []), shipped)
    (table,) = found.main.tables
    assert table.floor == ()
    assert table.entries[0].standing.over_floor_steady is None
    (note,) = found.notes
    assert note.startswith("12 episodes of the floor of pinnobs/X-v0, benchmark, nominal are left")
    assert "(hash anothe) than the estimators' (game)" in note
    elsewhere = exact([0.1] * 12, **OTHER)
    assert board(Stored(rows_of("ukf", [0.2] * 12), []), elsewhere).notes == ()


def test_of_several_floors_of_an_episode_the_most_precise_counts():
    rough = exact([0.3] * 12, effective_sample_size=100.0, estimator_hash="rough")
    shipped = exact([0.1] * 12, effective_sample_size=5000.0)
    particles = rows_of("particle_reference", [0.2] * 14, track=FLOOR, monte_carlo=0.01)
    found = floor.floors([*rough, *rows_of("ukf", [0.2]), *particles], shipped)
    own = found.by_game[GAME, FLOOR].rows
    assert [own[f"seed:{i}"]["nrmse"] for i in (0, 11, 12)] == [0.1, 0.1, 0.2]
    assert found.notes == ()


def test_of_floors_of_several_codes_the_latest_counts():
    """A mended floor is used even if the wrong one had more effective draws."""
    wrong = exact([0.1] * 12, effective_sample_size=5000.0, estimator_code="a", date="2026-01-01")
    mended = exact([0.3] * 12, estimator_code="b", date="2026-01-02")
    for rows in ([*wrong, *mended], [*mended, *wrong]):
        found = floor.floors(rows).by_game[GAME, FLOOR].rows
        assert {row["nrmse"] for row in found.values()} == {0.3}


def test_a_mean_between_states_that_no_output_tells_apart_bounds_no_error_modulo_these():
    """Of x = 1 or -1 the mean 0 has the least error from the truth, 1; but an estimate of 1 has the
    error 0 modulo the sign, so that a ratio to that of 0 says nothing."""
    between = [row | {"nrmse_steady_modulo": 0.9} for row in exact([1.0] * 12)]
    (table,) = main_of([*rows_of("ukf", [0.2] * 12), *between]).tables
    assert table.entries[0].standing.over_floor_steady is None
    assert table.entries[0].standing.over_floor_transient is not None


def test_the_note_says_how_precise_the_floor_is():
    played = rows_of("ukf", [0.2] * 12)
    (table,) = main_of([*played, *exact([0.1] * 12, effective_sample_size=120.0)]).tables
    assert table.note == (
        "Floor: exact Bayes, with at least 120 effective draws, fewer than the 500 that make it "
        "exact."
    )
    noisy = rows_of("particle_reference", [0.1] * 12, track=FLOOR, monte_carlo=0.0123)
    noisy[3]["monte_carlo"] = 0.02
    (table,) = main_of([*played, *noisy]).tables
    assert table.note == (
        "Floor: a particle reference in place of exact Bayes; the Monte-Carlo standard error of "
        "its RMS is at most 2 % in an episode."
    )


def test_a_file_of_floors_alone_has_a_table():
    (table,) = main_of(exact([0.1] * 12)).tables
    assert (table.entries, [e.name for e in table.floor]) == ((), ["exact_bayes"])
    assert main_of(exact([0.1] * 12)).lines == ()


def test_the_overview_has_the_geometric_mean_over_games_with_a_floor():
    made = []
    for facts, least in (({}, 0.1), (OTHER, 0.05)):
        made += rows_of("ukf", [0.2] * 12, **facts)
        made += exact([least] * 12, **facts)
    made += rows_of("ekf", [0.3] * 12)  # not in the other game
    made += rows_of("ukf", [0.2] * 12, env_id="pinnobs/Z-v0")
    part = main_of(made)
    ratios = {line.estimator: line.over_floor for line in part.lines}
    assert ratios["ukf"]["steady"].value == pytest.approx(8**0.5)  # of 2 and 4
    assert ratios["ekf"] == {}
    grid = ranks_table.grid(part.lines, part.places.peer)
    assert grid.only(["estimator", "/ Bayes"]).lines == (("ukf", "2.8"), ("ekf", ""))
    assert grid.note.endswith("over the games with a floor (X-v0, Y-v0).")
    plain = main_of(rows_of("ukf", [0.2] * 12))
    assert "/ Bayes" not in ranks_table.grid(plain.lines, "ukf").header


def test_estimators_trained_on_each_record_have_the_floor_of_these_records():
    own = {"training": {"per_record": True}, "track": "offline"}
    made = [*rows_of("ukf", [0.2] * 20), *rows_of("pinn", [0.3] * 12, **own)]
    made += [*exact([0.1] * 20), *exact([0.1] * 20, FLOOR_WHOLE)]
    found = board(Stored(made, []))
    (table,) = found.on_record.tables
    assert [e.standing.episodes for e in table.floor] == [12, 12]
    ratios = {e.name: e.standing.over_floor_steady.value for e in table.entries}
    assert ratios == {"ukf": pytest.approx(2), "pinn": pytest.approx(3)}


@pytest.mark.parametrize("width", [60, 80, 120, 200, None])
def test_no_width_cuts_a_number(width):
    found = board(Stored([*contenders(), *floors_of_contenders()], []))
    tables = [layouts for chapter in chapters(found) for layouts in chapter.tables]
    for grid in (grid for layouts in tables for grid in fitting(layouts, width)):
        text = grid.text(width)
        dropped = " ".join(text.partition("not shown at this width: ")[2].split()).split(", ")
        for name, cells in zip(grid.header, zip(*grid.lines, strict=True), strict=True):
            assert name in dropped or all(cell in text for cell in cells)


@pytest.mark.parametrize("width", [80, 120, 200, None])
def test_the_steady_ratio_is_seen_in_a_terminal_of_80_columns(width):
    part = main_of([*contenders(), *floors_of_contenders()])
    layouts = standings_table.layouts(part.tables[0])
    shown = "\n".join(grid.text(width) for grid in fitting(layouts, width))
    assert "/ Bayes" in shown.partition("not shown")[0]
