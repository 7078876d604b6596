"""The numbers across systems and conditions, against ones worked out by hand."""

import numpy as np
import pytest
from page_rows import row

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.places import FEWEST, Place
from pinnobs_gym.leaderboard.ranks import by_condition
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site import across


def line(name, ratio, us, track="online"):
    places = {} if ratio is None else {"steady": Place(Interval(ratio, ratio / 2, np.inf), None)}
    return ranks.Line(name, track, places, {}, us)


def test_costs_are_those_of_the_overview_with_the_cost_of_training():
    lines = [line("kkl", 0.5, 4.0), line("ekf", 1.0, 2.0), line("slow", 1.1, 3.0)]
    lines += [line("alone", None, 1.0), line("late", 3.0, 9.0, "offline")]
    table = across.costs(lines, {"kkl": 2.0, "ekf": None})
    assert table["estimator"] == ["kkl", "ekf", "slow", "late"]
    assert table["track"] == ["online", "online", "online", "offline"]
    assert table["seconds"] == [2.0, None, None, None]
    assert table["ratio"] == [0.5, 1.0, 1.1, 3.0]
    assert table["low"] == [0.25, 0.5, 0.55, 1.5]
    assert table["high"] == [None] * 4
    assert table["us"] == [4.0, 2.0, 3.0, 9.0]
    assert table["front"] == [True, True, False, True]  # ekf beats slow; late is of another track


def test_the_cost_of_training_is_the_median_over_rows():
    trained = [row(i, training={"seconds": s}) for i, s in enumerate((1.0, 2.0, 9.0))]
    plain = [row(0, estimator="ukf")]
    seconds = {c.name: across.training_seconds(c) for c in contenders(runs_of(trained + plain))}
    assert seconds == {"ekf": 2.0, "ukf": None}


def test_conditions_compare_with_the_peer_on_the_same_episodes():
    both = [
        row(seed, condition=condition, estimator=name, nrmse_steady=error * (1 + seed), env_id=env)
        for env in ("pinnobs/A-v0", "pinnobs/B-v0")
        for condition in ("nominal", "noise5")
        for seed in range(FEWEST)
        for name, error in (("ekf", 0.1), ("ukf", 0.05 if condition == "nominal" else 0.2))
    ]
    few = {"condition": "gap", "ranked": False}
    both += [row(seed, estimator="ukf", **few) for seed in range(FEWEST - 1)]
    players = contenders(runs_of(both))
    found = across.factors(players, by_condition(players))
    assert [each.of for each in found] == ["all systems", "A-v0", "B-v0"]
    for each in found:
        factors = {
            condition: {name: place.factor.value for name, place in places.items()}
            for condition, places in each.values.items()
        }
        assert factors.pop("gap", {}) == {}  # too few episodes
        assert factors["nominal"] == {"ekf": pytest.approx(2), "ukf": 1.0}
        assert factors["noise5"] == {"ekf": pytest.approx(0.5), "ukf": 1.0}
        assert dict(zip(each.estimators, each.worst, strict=True)) == {"ekf": 2, "ukf": 2}
    nominal = contenders(runs_of([r for r in both if r["condition"] == "nominal"]))
    assert across.factors(nominal, by_condition(nominal)) == []
