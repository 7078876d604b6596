"""Logs with reference states as scored episodes."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from driven_spring import Drive, DrivenSpring, moved, write_csv

from pinnobs_gym import evaluate, read_rows
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.curves import curves_of
from pinnobs_gym.scoring.log_evaluation import evaluate_logs
from pinnobs_gym.scoring.log_game import LogGame
from pinnobs_gym.scoring.log_playing import play_log
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES
from pinnobs_gym.simulation.record import Prior

SETUP = DrivenSpring.setups["benchmark"]


def between(drive, count=40, seed=1):
    """Times within a drive, none of them that of a sample."""
    return np.sort(np.random.default_rng(seed).uniform(drive.t[0], drive.t[-1], count))


def files(tmp_path, drive, times, name="a", **options):
    log = drive.write_log(tmp_path / f"{name}.csv")
    return [log], [drive.write_reference(tmp_path / f"{name}-ref.csv", times, **options)]


def errors_of(drive, times, estimator, log):
    """The errors (n, 2) at times, and covariances (n, 2, 2), by the exact motion from the estimate
    at the sample before, which the estimator makes of the log alone."""
    read = read_log(log, DrivenSpring(), Prior.of(DrivenSpring(), SETUP, 1))
    found = estimator(read.system).run(read.record)
    errors, covariances = [], []
    for t in times:
        k = np.searchsorted(drive.t, t, side="right") - 1
        x, F = moved(found.xhat[0, k], drive.u[k], t - drive.t[k])
        errors.append(x - drive.at(t))
        covariances.append(None if found.P is None else F @ found.P[0, k] @ F.T)
    return np.array(errors), covariances


@pytest.mark.parametrize(
    ("system", "name"),
    [
        *(("ReverseDuffing", name) for name in ("ekf", "ukf", "rts_smoother", "luenberger")),
        ("InductionMotor", "ekf"),
    ],
)
def test_a_reference_at_every_sample_gives_the_scores_of_the_game(tmp_path, system, name):
    """On a log that is written from a simulated episode, with the true states as reference."""
    game = Game.of(system)
    model, record = game.source.system, game.record([7])
    truth = game.episodes([7]).x[: record.num_samples, 0]
    log = write_csv(
        tmp_path / "log.csv",
        ["t", *(f"y{i + 1}" for i in range(model.ny))],
        record.t,
        *record.y[0].T,
    )
    reference = write_csv(tmp_path / "ref.csv", ["t", *model.state_names], record.t, *truth.T)
    (own,) = evaluate_logs(name, system, [log], [reference])
    (played,) = evaluate(name, system, episodes=1, seed=7)
    for score in (*SCORES, *OPTIONAL_SCORES):
        if score == "reference_steady":
            assert own[score] is None  # the Cramér-Rao bound is at true states, which are not there
        elif played[score] is None:
            assert own[score] is None
        else:
            assert own[score] == pytest.approx(played[score], rel=1e-9), score
    for window, states in played["state_rmse"].items():
        assert own["state_rmse"][window] == pytest.approx(states, rel=1e-9)
    assert (own["setup"], own["condition"], own["ranked"]) == ("log", "nominal", True)
    assert (own["log"], own["reference"], own["nx"]) == ("log.csv", "ref.csv", model.nx)


@pytest.mark.parametrize("name", ["ekf", "ckf", "mhe", "batch_least_squares", "luenberger"])
def test_estimates_between_samples_are_those_of_the_model(tmp_path, name):
    """Whether the rows without outputs are given to the estimator, as to the EKF, or the model
    moves its estimates, as those of the MHE, whose window counts rows."""
    drive = Drive()
    times = between(drive)
    logs, references = files(tmp_path, drive, times)
    # No process noise is assumed, so that covariances move by the model's matrix alone.
    cls = ESTIMATORS.resolve(name)
    without = {"assumed_noise": 0.0} if "assumed_noise" in cls.__dataclass_fields__ else {}
    (row,) = evaluate_logs(name, DrivenSpring, logs, references, options=without)

    def estimator(system):
        return cls.for_setup(system, SETUP, **without)

    errors, covariances = errors_of(drive, times, estimator, logs[0])
    scaled = errors / DrivenSpring.scale
    assert row["nrmse"] == pytest.approx(np.sqrt((scaled**2).mean()), rel=1e-4)
    assert row["rmse"] == pytest.approx(np.sqrt((errors**2).mean()), rel=1e-4)
    late = times - drive.t[0] > (drive.t[-1] - drive.t[0]) / 4
    assert row["nrmse_steady"] == pytest.approx(np.sqrt((scaled[late] ** 2).mean()), rel=1e-4)
    if name != "luenberger":
        sizes = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covariances, strict=True)]
        assert row["anees"] == pytest.approx(np.mean(sizes) / 2, rel=1e-4)


def test_states_without_a_reference_do_not_count(tmp_path):
    drive = Drive()
    times = between(drive)
    logs, references = files(tmp_path, drive, times, states=("v",))
    (row,) = evaluate_logs("ekf", DrivenSpring, logs, references)
    errors, _ = errors_of(drive, times, lambda system: EKF.for_setup(system, SETUP), logs[0])
    assert row["nrmse"] == pytest.approx(np.sqrt((errors[:, 1] ** 2).mean()) / 2, rel=1e-4)
    assert row["mae"] == pytest.approx(abs(errors[:, 1]).mean(), rel=1e-4)
    assert set(row["state_rmse"]["steady"]) == {"v"}
    assert row["nx"] == 1


def test_empty_cells_of_a_reference_do_not_count(tmp_path):
    """Of a consistent filter the normalised errors of the known states alone are those of their
    marginal distribution."""
    drive = Drive()
    times = drive.t[1:]
    log = drive.write_log(tmp_path / "log.csv")
    x = drive.x[1:].copy()
    x[::2, 0], x[1::3, 1], x[0] = np.nan, np.nan, np.nan
    reference = write_csv(tmp_path / "ref.csv", ("t", "q", "v"), times, *x.T)
    (row,) = evaluate_logs("ekf", DrivenSpring, [log], [reference])
    read = read_log(log, DrivenSpring(), Prior.of(DrivenSpring(), SETUP, 1))
    found = EKF.for_setup(read.system, SETUP).run(read.record)
    total, inside, count = 0.0, 0, 0
    for state, xhat, P in zip(x, found.xhat[0, 1:], found.P[0, 1:], strict=True):
        known = ~np.isnan(state)
        if known.any():
            error = (xhat - state)[known]
            total += error @ np.linalg.solve(P[np.ix_(known, known)], error)
            inside += (abs(error) <= 1.6448536 * np.sqrt(np.diag(P)[known])).sum()
            count += known.sum()
    assert row["anees"] == pytest.approx(total / count, rel=1e-9)
    assert row["coverage"] == pytest.approx(inside / count, rel=1e-9)


def test_rows_pair_by_content_whatever_the_files_are_called(tmp_path):
    drive = Drive()
    times = between(drive)
    logs, references = files(tmp_path, drive, times)
    results = tmp_path / "rows.jsonl"
    (first,) = evaluate_logs("ekf", DrivenSpring, logs, references, results=results)
    copies = [logs[0].rename(tmp_path / "other.csv")], [references[0].rename(tmp_path / "r.csv")]
    header, *lines = copies[0][0].read_text().splitlines()
    copies[0][0].write_text("\r\n".join([header, *lines]) + "\r\n\r\n")
    (again,) = evaluate_logs("ekf", DrivenSpring, *copies, results=results)
    assert again == first  # taken from the file
    assert len(read_rows(results)) == 1
    (other,) = evaluate_logs("ukf", DrivenSpring, *copies, results=results)
    assert other["episode"] == first["episode"]
    assert other["log"] == "other.csv"


@pytest.mark.parametrize("changed", ["log", "reference"])
def test_another_content_is_another_episode(tmp_path, changed):
    drive = Drive()
    logs, references = files(tmp_path, drive, between(drive))
    results = tmp_path / "rows.jsonl"
    (first,) = evaluate_logs("ekf", DrivenSpring, logs, references, results=results)
    path = logs[0] if changed == "log" else references[0]
    lines = path.read_text().splitlines()
    cells = lines[20].split(",")
    lines[20] = ",".join([cells[0], repr(float(cells[1]) + 1e-6), *cells[2:]])
    path.write_text("\n".join(lines))
    (second,) = evaluate_logs("ekf", DrivenSpring, logs, references, results=results)
    assert second["episode"] != first["episode"]
    assert second["game_hash"] == first["game_hash"]
    assert len(read_rows(results)) == 2


def test_rows_of_a_log_under_two_names_are_the_same_episode(tmp_path):
    drive = Drive()
    given = files(tmp_path, drive, between(drive))
    found = evaluate_logs("ekf", DrivenSpring, *given)
    paths = [tmp_path / "one.jsonl", tmp_path / "two.jsonl"]
    rows_module.append(paths[0], found)
    rows_module.append(paths[1], [{**row, "log": "renamed.csv"} for row in found])
    assert len(rows_module.load_all(paths).rows) == 1
    wrong = tmp_path / "wrong.jsonl"
    rows_module.append(wrong, [{**row, "log": ""} for row in found])
    with pytest.raises(ValueError, match='log=""; expected a text'):
        rows_module.read(wrong)


def played(tmp_path, drive, times, **options):
    """An EKF on a log."""
    logs, references = files(tmp_path, drive, times, **options)
    game = LogGame.of(DrivenSpring(), SETUP, logs, references)
    return play_log(game, EKF.for_setup(game.source.system, SETUP), next(iter(game.logs)))


def test_the_figure_has_the_reference_as_dots_where_it_is_known(tmp_path):
    drive = Drive()
    times = between(drive)
    figure = played(tmp_path, drive, times, states=("v",)).figure("")
    panels = [{line.get_label(): line for line in axes.lines} for axes in figure.axes]
    assert len(panels[0]["reference"].get_xdata()) == 0
    dots = panels[1]["reference"].get_xydata()
    np.testing.assert_allclose(dots, [[t, drive.at(t)[1]] for t in times])
    for panel in panels:  # the estimate at all samples and all times of the reference
        assert len(panel["estimate"].get_xdata()) == len(drive.t) + len(times)
    assert all(np.isfinite(axes.get_ylim()).all() for axes in figure.axes)


def test_curves_have_the_errors_at_the_reference(tmp_path):
    drive = Drive(samples=2000)
    times = between(drive)
    found = curves_of(played(tmp_path, drive, times))
    np.testing.assert_allclose(found.t, times - drive.t[0], rtol=1e-12)
    log = tmp_path / "a.csv"
    errors, _ = errors_of(drive, times, lambda system: EKF.for_setup(system, SETUP), log)
    expected = np.sqrt(((errors / DrivenSpring.scale) ** 2).mean(axis=1))
    np.testing.assert_allclose(found.error[0], expected, rtol=1e-3)
    shown = np.isin(found.example.t, times - drive.t[0])
    assert shown.sum() == len(times)  # none is lost by thinning
    np.testing.assert_array_equal(np.isnan(found.example.x).any(axis=1), ~shown)


def test_another_noise_or_prior_is_another_game(tmp_path):
    drive = Drive()
    given = files(tmp_path, drive, between(drive))
    hashes = {
        evaluate_logs("ekf", DrivenSpring, *given, setup=setup)[0]["game_hash"]
        for setup in (SETUP, replace(SETUP, noise_std=0.1), replace(SETUP, xhat0=(0.0, 0.0)))
    }
    assert len(hashes) == 3


def test_fresh_scores_replace_the_stored_ones(tmp_path):
    drive = Drive()
    given = files(tmp_path, drive, between(drive))
    results = tmp_path / "rows.jsonl"
    (first,) = evaluate_logs("ekf", DrivenSpring, *given, results=results)
    (second,) = evaluate_logs("ekf", DrivenSpring, *given, results=results, fresh=True)
    assert second["date"] > first["date"]
    assert [row["date"] for row in read_rows(results)] == [second["date"]]


def test_several_logs_are_episodes_of_one_game(tmp_path):
    drives = [Drive(samples=40, seed=1), Drive(samples=55, seed=2)]
    given = [
        files(tmp_path, drive, between(drive), name)
        for drive, name in zip(drives, "ab", strict=True)
    ]
    logs, references = ([part[0] for part in parts] for parts in zip(*given, strict=True))
    rows = evaluate_logs("ekf", DrivenSpring, logs, references, results=tmp_path / "rows.jsonl")
    assert [row["log"] for row in rows] == ["a.csv", "b.csv"]
    assert len({row["episode"] for row in rows}) == 2
    assert len({row["game_hash"] for row in rows}) == 1
    alone = evaluate_logs("ekf", DrivenSpring, logs[1:], references[1:])[0]
    assert alone["nrmse"] == rows[1]["nrmse"]
    with pytest.raises(ValueError, match="are the same"):
        evaluate_logs("ekf", DrivenSpring, [logs[0]] * 2, [references[0]] * 2)
    with pytest.raises(ValueError, match=r"2 log\(s\) and 1 reference"):
        evaluate_logs("ekf", DrivenSpring, logs, references[:1])


@dataclass(frozen=True)
class LosesOne(OfflineEstimator):
    """Estimates of zero, but for one sample."""

    name = "loses_one"

    def run(self, record):
        xhat = np.zeros((1, record.num_samples, self.system.nx))
        xhat[0, 3] = np.nan
        return Estimates(xhat)


def test_an_estimate_that_is_lost_where_nothing_is_known_counts_as_diverged(tmp_path):
    drive = Drive()
    given = files(tmp_path, drive, drive.t[20:])
    (row,) = evaluate_logs(LosesOne, DrivenSpring, *given)
    assert row["diverged"]
    assert row["nrmse"] == np.inf


@dataclass(frozen=True)
class Wheel(DrivenSpring):
    """The spring, whose position is an angle."""

    state_period = (2 * np.pi, None)
    output_period = (2 * np.pi,)


def test_an_angle_of_a_reference_counts_modulo_its_period(tmp_path):
    drive = Drive()
    log = drive.write_log(tmp_path / "log.csv")
    turned = drive.x + np.array([2 * np.pi, 0.0])
    rows = []
    for name, x in (("a", drive.x), ("b", turned)):
        path = write_csv(tmp_path / f"{name}.csv", ("t", "q", "v"), drive.t, *x.T)
        rows += evaluate_logs("ekf", Wheel, [log], [path])
    assert rows[0]["nrmse"] < 0.1
    assert rows[1]["nrmse"] == pytest.approx(rows[0]["nrmse"], rel=1e-9)


def test_the_transient_window_is_a_quarter_of_the_log_from_its_first_sample(tmp_path):
    """Also where the reference begins later."""
    drive = Drive()
    span = drive.t[-1] - drive.t[0]
    times = np.linspace(drive.t[0] + 0.1 * span, drive.t[-1], 50)
    given = files(tmp_path, drive, times)
    (row,) = evaluate_logs("ekf", DrivenSpring, *given)
    errors, _ = errors_of(drive, times, lambda system: EKF.for_setup(system, SETUP), given[0][0])
    scaled = (errors / DrivenSpring.scale) ** 2
    early = times - drive.t[0] <= span / 4
    early[0] = False  # the first sample is a window of its own
    assert row["nrmse_transient"] == pytest.approx(np.sqrt(scaled[early].mean()), rel=1e-4)
    (own,) = evaluate_logs(
        "ekf", DrivenSpring, *given, setup=replace(SETUP, transient=0.6 * span, duration=span)
    )
    early = times - drive.t[0] <= 0.6 * span
    assert own["nrmse_steady"] == pytest.approx(np.sqrt(scaled[~early].mean()), rel=1e-4)


@pytest.mark.parametrize(("window", "other"), [("transient", "up to"), ("steady", "after")])
def test_a_window_without_a_state_is_noted(tmp_path, window, other):
    drive = Drive()
    end = drive.t[0] + (drive.t[-1] - drive.t[0]) / 4
    times = between(drive)
    times = times[times > end] if window == "transient" else times[times <= end]
    game = LogGame.of(DrivenSpring(), SETUP, *files(tmp_path, drive, times))
    (note,) = game.notes
    assert f"has no state {other} t={end:g} s, where the transient ends; {window} errors" in note
    place = times[1] if window == "transient" else times[-1]
    assert note.endswith(f"at t={place:g} s instead")
    assert not LogGame.of(DrivenSpring(), SETUP, *files(tmp_path, drive, between(drive))).notes


def test_a_reference_with_the_values_of_an_output_is_noted(tmp_path):
    drive = Drive()
    log = drive.write_log(tmp_path / "a.csv")
    x = np.array([drive.at(t) for t in drive.t])
    reference = write_csv(tmp_path / "b.csv", ("t", "q", "v"), drive.t, drive.y, x[:, 1])
    (note,) = LogGame.of(DrivenSpring(), SETUP, [log], [reference]).notes
    assert "q has the values of output q at all 60 samples in common" in note
    reference = write_csv(tmp_path / "c.csv", ("t", "q", "v"), drive.t, *x.T)
    assert not LogGame.of(DrivenSpring(), SETUP, [log], [reference]).notes


def test_a_file_in_place_of_a_list_is_refused(tmp_path):
    logs, references = files(tmp_path, Drive(), between(Drive()))
    with pytest.raises(ValueError, match=r"logs='.*a.csv'; expected a list of files"):
        evaluate_logs("ekf", DrivenSpring(), str(logs[0]), references)
    with pytest.raises(ValueError, match=r"references='.*'; expected a list of files"):
        evaluate_logs("ekf", DrivenSpring(), logs, references[0])
