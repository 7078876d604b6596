"""Settling and errors over the reference, against ones worked out by hand or by other means."""

import numpy as np
from page_rows import lines_of, row

from pinnobs_gym.leaderboard.site import over_episodes


def test_settling_is_the_share_that_has_settled_by_then():
    times = [2.0, 1.0, np.inf, 1.0, 0.5]
    group = [row(i, settling=t, diverged=i == 4) for i, t in enumerate(times)]
    late = [row(0, settling=4.0)]
    table = over_episodes.settling({"ekf": group, "late": late, "never": [row(0, settling=np.inf)]})
    assert lines_of(table, "ekf") == [(0.0, 0.0), (1.0, 0.4), (2.0, 0.6), (4.0, 0.6)]
    assert lines_of(table, "late") == [(0.0, 0.0), (4.0, 1.0), (4.0, 1.0)]
    assert lines_of(table, "never") == [(0.0, 0.0), (4.0, 0.0)]


def test_a_settling_curve_of_many_episodes_is_that_of_all_at_the_times_drawn():
    times = np.random.default_rng(0).exponential(size=1000)
    table = over_episodes.settling(
        {"ekf": [row(i, settling=t) for i, t in enumerate(times.tolist())]}
    )
    drawn = lines_of(table, "ekf")
    assert len(drawn) <= over_episodes.STEPS + 2
    for t, share in drawn:
        assert share == np.mean(times <= t)


def test_ratios_are_quantiles_of_those_that_have_one():
    """The reference of each episode is another, so that the ratio of root mean squares is not that
    of the ratios."""
    cases = [(4.0, 1.0), (2.0, 2.0), (1.0, 0.5), (9.0, None)]
    group = [
        row(i, nrmse_steady_modulo=error, nrmse_steady=99.0, reference_steady=reference)
        for i, (error, reference) in enumerate(cases)
    ]
    best = [row(0, nrmse_steady_modulo=0.5, reference_steady=1.0)]
    lost = [row(i, nrmse_steady_modulo=e, reference_steady=1.0) for i, e in enumerate((np.inf, 1))]
    table = over_episodes.ratios({"lost": lost, "ekf": group, "none": [row(0)], "best": best})
    assert table["estimator"] == ["best", "ekf", "lost"]
    # (16 + 4 + 1)/(1 + 4 + 1/4) = 4
    assert table["rms"] == [0.5, 2.0, None]
    assert [table[q][1] for q in ("q10", "q25", "q75", "q90")] == [1.0, 1.0, 4.0, 4.0]
    assert [table[q][2] for q in ("q10", "q25", "q75", "q90")] == [1.0, 1.0, None, None]
