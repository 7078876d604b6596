import numpy as np
import pytest
from scipy.stats import binom

from pinnobs_gym import leaderboard
from pinnobs_gym.metrics import SCORES


def rows_of(estimator, nrmse, track="online", diverged=None, **changes):
    diverged = [False] * len(nrmse) if diverged is None else diverged
    return [
        {
            **dict.fromkeys(SCORES, value),
            "nrmse_tail_modulo": value,
            "env_id": "pinnobs/X-v0",
            "setup": "benchmark",
            "condition": "nominal",
            "estimator": estimator,
            "config_hash": estimator,
            "track": track,
            "knows": ["model"],
            "training": {},
            "us_per_step": 1.0,
            "diverged": bad,
            "episode_seed": i,
            **changes,
        }
        for i, (value, bad) in enumerate(zip(nrmse, diverged, strict=True))
    ]


def test_estimators_are_ranked_by_median_within_their_track():
    rows = [
        *rows_of("worse", [0.3, 0.1, 0.2]),
        *rows_of("better", [0.1, 0.1, 0.4]),
        *rows_of("offline", [0.01, 0.01, 0.01], track="offline"),
        *rows_of("worst", [0.1, 0.1, 0.1], diverged=[True, True, False]),
    ]
    (table,) = leaderboard.tables(rows)
    assert [s.estimator for s in table.standings] == ["better", "worse", "worst", "offline"]
    assert np.isinf(table.standings[2].nrmse.value)
    assert table.standings[2].diverged.value == pytest.approx(2 / 3)


def test_the_median_interval_is_the_textbook_one():
    # n = 100: the 40th and 61st smallest values; coverage 1 - 2 P(Binomial(100, 1/2) <= 39).
    interval = leaderboard.median(np.arange(1.0, 101.0))
    assert (interval.value, interval.low, interval.high) == (50.5, 40.0, 61.0)
    assert 1 - 2 * binom.cdf(39, 100, 0.5) >= 0.95 > 1 - 2 * binom.cdf(40, 100, 0.5)


def test_the_median_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    samples = rng.exponential(size=(2000, 25))
    inside = [
        m.low <= np.log(2) <= m.high for m in (leaderboard.median(sample) for sample in samples)
    ]
    assert 0.94 <= np.mean(inside) <= 0.99


def test_infinite_scores_stay_in_the_median():
    interval = leaderboard.median(np.array([1.0, np.inf, 2.0, np.inf, np.inf]))
    assert np.isinf(interval.value)
    assert interval.low == 1.0


def test_wilsons_interval():
    # Wilson 1927 as in Newcombe 1998, table I: 15 of 148, 95 %: 0.0624 to 0.1605.
    interval = leaderboard.rate(15, 148)
    assert interval.low == pytest.approx(0.0624, abs=5e-5)
    assert interval.high == pytest.approx(0.1605, abs=5e-5)


def test_markdown_has_a_table_per_game_with_all_columns():
    text = leaderboard.markdown(leaderboard.tables(rows_of("ekf", [0.1, 0.2, 0.3])))
    lines = text.splitlines()
    header = next(line for line in lines if line.startswith("| "))
    body = lines[lines.index(header) + 2]
    assert header.count("|") == body.count("|") == len(leaderboard.HEADER) + 1
    assert "## pinnobs/X-v0, benchmark, nominal" in lines
    assert "ekf" in body
    assert "0.2" in body


def test_unequal_episodes_are_pointed_out():
    same = leaderboard.tables([*rows_of("a", [0.1, 0.2]), *rows_of("b", [0.1, 0.2])])
    assert same[0].note == ""
    uneven = leaderboard.tables([*rows_of("a", [0.1, 0.2]), *rows_of("b", [0.1])])
    assert "Not all online estimators" in uneven[0].note
    assert uneven[0].note in leaderboard.markdown(uneven)
    apart = [*rows_of("a", [0.1, 0.2]), *rows_of("b", [0.1], track="offline")]
    assert leaderboard.tables(apart)[0].note == ""


def test_training_is_told_in_the_row():
    facts = {"config": {"budget": 25.0}, "iterations": 1000, "seconds": 25.0}
    standing = leaderboard.standing(rows_of("pinn", [0.1], training=facts))
    assert standing.training == "budget 25 s, 1000 iterations, 25 CPU s"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00123456, "0.00123"), (np.inf, "∞"), (1234.5, "1234"), (12.345, "12.3"), (0, "0")],
)
def test_numbers(value, text):
    assert leaderboard.number(value) == text
