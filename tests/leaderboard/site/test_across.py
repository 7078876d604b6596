"""The numbers across systems and conditions, against ones worked out by hand."""

import numpy as np
import pytest
from page_rows import row

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site import across


def line(name, ratio, us, track="online"):
    interval = None if ratio is None else Interval(ratio, ratio / 2, np.inf)
    return ranks.Line(name, track, interval, None, {}, us)


def test_costs_are_those_of_the_overview_with_the_cost_of_training():
    lines = [line("kkl", 0.5, 4.0), line("ekf", 1.0, 2.0), line("slow", 1.1, 3.0)]
    lines += [
        line("lost", np.inf, 1.0),
        line("alone", None, 1.0),
        line("late", 3.0, 9.0, "offline"),
    ]
    table = across.costs(lines, {"kkl": 2.0, "ekf": None})
    assert table["estimator"] == ["kkl", "ekf", "slow", "late"]
    assert table["seconds"] == [2.0, None, None, None]
    assert table["ratio"] == [0.5, 1.0, 1.1, 3.0]
    assert table["high"] == [None] * 4
    assert table["front"] == [True, True, False, True]  # ekf beats slow; late is of another track


def test_the_cost_of_training_is_the_median_over_rows():
    trained = [row(i, training={"seconds": s}) for i, s in enumerate((1.0, 2.0, 9.0))]
    plain = [row(0, estimator="ukf")]
    seconds = {c.name: across.training_seconds(c) for c in contenders(runs_of(trained + plain))}
    assert seconds == {"ekf": 2.0, "ukf": None}


def test_conditions_compare_with_the_peer_on_the_same_episodes():
    both = [
        row(seed, condition=condition, estimator=name, nrmse=nrmse * (1 + seed), env_id=env)
        for env in ("pinnobs/A-v0", "pinnobs/B-v0")
        for condition in ("nominal", "noise5")
        for seed in range(4)
        for name, nrmse in (("ekf", 0.1), ("ukf", 0.05 if condition == "nominal" else 0.4))
    ]
    found = across.factors(contenders(runs_of(both)))
    assert [each.of for each in found] == ["all systems", "A-v0", "B-v0"]
    for each in found:
        assert each.values["nominal"] == {"ekf": 0.0, "ukf": pytest.approx(np.log(0.5))}
        assert each.values["noise5"]["ukf"] == pytest.approx(np.log(4))
        assert dict(zip(each.estimators, each.worst, strict=True)) == {"ekf": 2, "ukf": 2}
    nominal = [r for r in both if r["condition"] == "nominal"]
    assert across.factors(contenders(runs_of(nominal))) == []
