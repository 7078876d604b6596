"""How scores were made: commands, settings, dates and versions."""

from page_rows import row

from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site import method


def test_commands_name_what_was_played():
    nominal = [row(seed, estimator=name) for seed in (2, 3) for name in ("ukf", "ekf")]
    other = [row(2, condition="noise5", ranked=False)]
    trained = {"config": {"budget": 4.0}, "per_record": True}
    setup = [row(0, setup="paper", estimator="pinn_obs (paper's loss)", training=trained)]
    nominal += [row(2, estimator="ukf, tuned")]
    assert method.commands(runs_of(nominal + other + setup)) == [
        "pinnobs leaderboard --systems A --estimators ekf ukf 'ukf, tuned' --episodes 2 --seed 2",
        "pinnobs leaderboard --systems A --estimators pinn_obs --setup paper --episodes 1 "
        "--trained-episodes 1 --budget 4",
        "pinnobs leaderboard --systems A --estimators ekf --condition noise5 --episodes 1 --seed 2",
    ]


def test_methods_name_settings_and_dates():
    options = {"gate": None, "assumed_noise": 3e-3, "config": {"layers": 3}}
    group = [row(0, options=options), row(1, options=options, date="2030-01-05T00:00:00")]
    (contender,) = contenders(runs_of(group))
    found = method.estimator_method(contender)
    assert found.settings == "assumed_noise=0.003, config: layers=3"
    assert (found.episodes, found.dates) == (2, "2030-01-02 to 2030-01-05")
    versions = method.versions([*group, row(versions={"numpy": "1", "torch": "3"})])
    assert versions == {"numpy": "1, 2", "torch": "3"}
