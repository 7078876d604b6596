"""What `pinnobs estimate` says and writes of how well a log fits the model."""

import csv

import numpy as np
import pytest

from pinnobs_gym.cli import main
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF

COMMAND = ["estimate", "--system", "InductionMotor", "--log", "log.csv"]


@pytest.fixture
def record(tmp_path, monkeypatch):
    """The record of a log, written as log.csv, in which outputs are missing."""
    monkeypatch.chdir(tmp_path)
    source = EpisodeSource("InductionMotor", duration=0.3)
    record = source.record(source.play(source.draw(source.streams([0]))))
    record.y[0, ::7, 0] = np.nan
    record.y[0, 5:9, 1] = np.nan
    write(record, record.y[0])
    return record


def write(record, y):
    with open("log.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "y1", "y2"])
        for t, row in zip(record.t.tolist(), y.tolist(), strict=True):
            writer.writerow([t, *("" if np.isnan(cell) else cell for cell in row)])


def table():
    with open("estimates.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_right_log_is_judged_without_a_warning(record, capsys):
    assert main([*COMMAND, "--strict"]) == 0
    told = capsys.readouterr().out
    assert "NIS, 1 expected" in told
    assert "outputs missing: y1 14.3 %, y2 1.33 %" in told
    assert "warning" not in told


def test_strict_ends_with_status_1_on_a_warning_and_writes_all_the_same(record, capsys):
    write(record, 1000 * record.y[0])
    assert main(COMMAND) == 0
    assert "warning: " in capsys.readouterr().out
    assert main([*COMMAND, "--strict", "--out", "strict.csv"]) == 1
    with open("estimates.csv") as usual, open("strict.csv") as strict:
        assert usual.read() == strict.read()


def test_innovations_are_written_and_empty_where_the_output_is_missing(record):
    assert main(COMMAND) == 0
    own = EKF.for_setup(*type_and_setup()).run(record)
    rows = table()
    assert list(rows[0])[-4:] == [
        "y1_innovation",
        "y2_innovation",
        "y1_innovation_std",
        "y2_innovation_std",
    ]
    for i, name in enumerate(("y1", "y2")):
        missing = np.isnan(record.y[0, :, i])
        for column, values in (
            (f"{name}_innovation", own.innovation[0, :, i]),
            (f"{name}_innovation_std", np.sqrt(own.S[0, :, i, i])),
        ):
            cells = np.array([row[column] for row in rows])
            assert (cells[missing] == "").all()
            np.testing.assert_allclose(cells[~missing].astype(float), values[~missing], rtol=1e-8)


def type_and_setup():
    source = EpisodeSource("InductionMotor", duration=0.3)
    return source.system, source.setup


def test_an_observer_without_covariances_writes_innovations_alone(record):
    assert main([*COMMAND, "--estimator", "luenberger"]) == 0
    assert list(table()[0])[-2:] == ["y1_innovation", "y2_innovation"]


def test_a_smoother_writes_none(record):
    assert main([*COMMAND, "--estimator", "rts_smoother"]) == 0
    assert not any("innovation" in name for name in table()[0])
