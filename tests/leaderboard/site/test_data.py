"""The numbers of the page, against ones worked out by hand or by other means."""

import numpy as np
import pytest

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.site import across, data, method, palette
from pinnobs_gym.scoring.curves import Curves, Example
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES


def row(seed=0, **changes):
    base = dict.fromkeys(SCORES, 0.1) | dict.fromkeys(OPTIONAL_SCORES)
    facts = {"env_id": "pinnobs/A-v0", "setup": "benchmark", "condition": "nominal"}
    facts |= {"ranked": True, "nx": 2, "estimator": "ekf", "track": "online", "knows": ["model"]}
    facts |= {"options": {}, "config_hash": "h", "training": {}, "training_seed": None}
    facts |= {"us_per_step": 1.0, "date": "2030-01-02T00:00:00", "versions": {"numpy": "2"}}
    return base | facts | {"diverged": False, "episode_seed": seed} | changes


def curves(error, t=(0.0, 1.0, 2.0), reference=None, seeds=None, seed=0):
    error, t = np.asarray(error, dtype=np.float32), np.asarray(t)
    x = np.stack([t, -t], axis=-1)
    example = Example(seed, t, x, x + 1, x[:, :1], np.full(x.shape, 0.25))
    seeds = np.arange(len(error)) if seeds is None else np.asarray(seeds)
    reference = None if reference is None else np.asarray(reference)
    return Curves(t, seeds, error, reference, example, ("a", "b (m)"), {0: 0})


def lines_of(table, name):
    keys = [key for key in table if key != "estimator"]
    places = [i for i, each in enumerate(table["estimator"]) if each == name]
    return [tuple(table[key][i] for key in keys) for i in places]


def test_settling_is_the_share_that_has_settled_by_then():
    times = [2.0, 1.0, np.inf, 1.0, 0.5]
    group = [row(i, settling=t, diverged=i == 4) for i, t in enumerate(times)]
    late = [row(0, settling=4.0)]
    table = data.settling({"ekf": group, "late": late, "never": [row(0, settling=np.inf)]})
    assert lines_of(table, "ekf") == [(0.0, 0.0), (1.0, 0.4), (2.0, 0.6), (4.0, 0.6)]
    assert lines_of(table, "late") == [(0.0, 0.0), (4.0, 1.0), (4.0, 1.0)]
    assert lines_of(table, "never") == [(0.0, 0.0), (4.0, 0.0)]


def test_a_settling_curve_of_many_episodes_is_that_of_all_at_the_times_drawn():
    times = np.random.default_rng(0).exponential(size=1000)
    table = data.settling({"ekf": [row(i, settling=t) for i, t in enumerate(times.tolist())]})
    drawn = lines_of(table, "ekf")
    assert len(drawn) <= data.STEPS + 2
    for t, share in drawn:
        assert share == np.mean(times <= t)


def test_error_over_time_is_median_and_band():
    rng = np.random.default_rng(1)
    error = np.exp(rng.normal(size=(11, 3)))
    error[:3, 2] = np.inf
    table = data.errors({"ekf": curves(error), "lost": curves([[np.nan, np.inf, 1.0]])})
    for k, (t, median, low, high) in enumerate(lines_of(table, "ekf")):
        ordered = sorted(error[:, k].tolist())
        assert t == k
        assert median == pytest.approx(ordered[5], rel=1e-3)
        assert low == pytest.approx(ordered[1], rel=1e-3)  # of 11 the second is 10 % or more
        assert high == (None if k == 2 else pytest.approx(ordered[9], rel=1e-3))
    # Where nothing counts there is no point, and where nothing is finite a gap.
    assert lines_of(table, "lost") == [(1.0, None, None, None), (2.0, 1.0, 1.0, 1.0)]


def test_the_median_of_an_even_number_is_between_the_two():
    table = data.errors({"ekf": curves([[1.0], [2.0], [4.0], [np.inf]], t=[0.0])})
    assert lines_of(table, "ekf") == [(0.0, 3.0, 1.0, None)]


def test_the_reference_is_of_each_episode_once():
    first = curves(np.ones((2, 3)), reference=[[1, 2, 3], [3, 4, 5]])
    second = curves(np.ones((2, 3)), reference=[[3, 4, 5], [8, 8, 8]], seeds=[1, 2])
    table = data.reference([first, second, curves(np.ones((1, 3)))])
    assert table == {"t": [0, 1, 2], "median": [3, 4, 5]}
    assert data.reference([curves(np.ones((1, 3)))]) == {"t": [], "median": []}


def test_ratios_are_quantiles_of_those_that_have_one():
    values = [4.0, 1.0, 2.0, np.inf, None]
    group = [row(i, reference_ratio=value) for i, value in enumerate(values)]
    best = [row(0, reference_ratio=0.5)]
    table = data.ratios({"ekf": group, "none": [row(0)], "best": best})
    assert table["estimator"] == ["best", "ekf"]
    assert table["median"] == [0.5, 3.0]
    assert [table[q][1] for q in ("q10", "q25", "q75", "q90")] == [1.0, 1.0, 4.0, None]


def test_the_example_is_of_the_episode_that_most_have():
    own = {"a": curves(np.ones((1, 3)), seed=5), "b": curves(np.ones((1, 3)))}
    found = data.states({**own, "c": curves(np.ones((1, 3)))})
    assert found is not None
    assert found.seed == 0
    assert found.truth == {
        "t": [0, 1, 2],
        "x0": [0, 1, 2],
        "x1": [0, -1, -2],
        "y0": [0, 1, 2],
    }
    assert set(found.estimates["estimator"]) == {"b", "c"}
    assert lines_of(found.estimates, "b")[1] == (1, 2, 0.5, 0, 0.5)
    assert data.states({}) is None


def line(name, ratio, us, track="online"):
    interval = None if ratio is None else Interval(ratio, ratio / 2, np.inf)
    return ranks.Line(name, track, interval, None, {}, us)


def test_standings_are_those_of_the_overview_with_the_cost_of_training():
    trained = [row(i, training={"seconds": s}) for i, s in enumerate((1.0, 2.0, 9.0))]
    lines = [line("kkl", 0.5, 4.0), line("ekf", 1.0, 2.0), line("slow", 1.1, 3.0)]
    lines += [
        line("lost", np.inf, 1.0),
        line("alone", None, 1.0),
        line("late", 3.0, 9.0, "offline"),
    ]
    table = across.standings(lines, {"kkl": {"A": trained}, "ekf": {"A": [row()]}})
    assert table["estimator"] == ["kkl", "ekf", "slow", "late"]
    assert table["seconds"] == [2.0, None, None, None]
    assert table["ratio"] == [0.5, 1.0, 1.1, 3.0]
    assert table["high"] == [None] * 4
    assert table["front"] == [True, True, False, True]  # ekf beats slow; late is of another track


def test_conditions_compare_with_the_peer_on_the_same_episodes():
    both = [
        row(seed, condition=condition, estimator=name, nrmse=nrmse * (1 + seed), env_id=env)
        for env in ("pinnobs/A-v0", "pinnobs/B-v0")
        for condition in ("nominal", "noise5")
        for seed in range(4)
        for name, nrmse in (("ekf", 0.1), ("ukf", 0.05 if condition == "nominal" else 0.4))
    ]
    found = across.conditions(both)
    assert list(found) == ["all systems", "A-v0", "B-v0"]
    for values in found.values():
        assert values["nominal"] == {"ekf": 0.0, "ukf": pytest.approx(np.log(0.5))}
        assert values["noise5"]["ukf"] == pytest.approx(np.log(4))
    assert across.conditions([r for r in both if r["condition"] == "nominal"]) == {}


def test_games_are_the_ranked_one_and_then_the_nominal_one():
    group = [row(condition=c, ranked=c == "load_step") for c in ("nominal", "load_step", "noise5")]
    games = data.games_of(data.ordered(ranks.contenders(group), []), [])
    assert [(game.condition, game.ranked) for game in games] == [
        ("load_step", True),
        ("nominal", False),
    ]
    assert games[0].states is None
    assert games[0].errors["t"] == []


def test_every_estimator_has_a_style_of_its_own():
    names = [f"e{i}" for i in range(3 * len(palette.LIGHT))]
    styles = palette.styles([*names, "ekf"])
    assert len({(s.light, s.dash) for s in styles.values()}) == len(names) + 1
    assert len({(s.dark, s.shape) for s in styles.values()}) == len(names) + 1
    assert palette.styles(["ekf", "e0"])["e0"] == styles["e0"]


def luminance(colour):
    parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize(
    ("colours", "ground"), [(palette.LIGHT, "#ffffff"), (palette.DARK, "#14171b")]
)
def test_colours_stand_out_from_the_ground(colours, ground):
    """The contrast that WCAG 2 asks of graphics, by its own formula."""
    for colour in colours:
        high, low = sorted((luminance(colour), luminance(ground)), reverse=True)
        assert (high + 0.05) / (low + 0.05) >= 3


def test_commands_name_what_was_played():
    nominal = [row(seed, estimator=name) for seed in (2, 3) for name in ("ukf", "ekf")]
    other = [row(2, condition="noise5", ranked=False)]
    trained = {"config": {"budget": 4.0}, "per_record": True}
    setup = [row(0, setup="paper", estimator="pinn_obs", training=trained)]
    assert method.commands(nominal + other + setup) == [
        "pinnobs leaderboard --systems A --estimators ekf ukf --episodes 2 --seed 2",
        "pinnobs leaderboard --systems A --estimators pinn_obs --setup paper --episodes 1 "
        "--trained-episodes 1 --budget 4",
        "pinnobs leaderboard --systems A --estimators ekf --condition noise5 --episodes 1 --seed 2",
    ]


def test_methods_tell_settings_and_dates():
    options = {"gate": None, "process_noise": 1e-4, "config": {"layers": 3}}
    group = [row(0, options=options), row(1, options=options, date="2030-01-05T00:00:00")]
    (told,) = method.methods({"ekf": {"A": group}})
    assert told.settings == "process_noise=0.0001, config: layers=3"
    assert (told.episodes, told.dates) == (2, "2030-01-02 to 2030-01-05")
    versions = method.versions([*group, row(versions={"numpy": "1", "torch": "3"})])
    assert versions == {"numpy": "1, 2", "torch": "3"}
