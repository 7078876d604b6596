"""Jobs on a disk that is full, or in a folder that cannot be written to."""

import errno

import pytest
from damage import full_disk

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.learned import trained_file
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.files import CannotWrite
from pinnobs_gym.leaderboard.jobs import job as job_module
from pinnobs_gym.leaderboard.jobs.engine import Engine, Workers
from pinnobs_gym.leaderboard.jobs.job import Job
from pinnobs_gym.scoring import rows

GAME = Game.of("ReverseDuffing")


def job(folder, estimator="open_loop", seed=0):
    return Job(GAME, estimator, 1, seed, folder)


def ended(jobs):
    return [(each.job.seed, each.error) for each in Engine(Workers(1)).run(jobs)]


def test_without_curves_and_logs_jobs_succeed_and_one_line_of_each_is_said(tmp_path, caplog):
    for name in ("curves", "tensorboard"):
        (tmp_path / name).write_text("in the way")
    assert ended([job(tmp_path), job(tmp_path, seed=1)]) == [(0, None), (1, None)]
    stored = rows.load(tmp_path / "rows.jsonl")
    assert len(stored.rows) == 2
    assert stored.failures == []
    lines = [line for line in caplog.messages if "cannot write" in line]
    endings = [line.rpartition("; ")[2] for line in lines]
    assert endings == [
        "scores are stored without these errors over time",
        "what follows is done without this TensorBoard log",
    ]


def test_where_rows_cannot_be_written_the_run_stops_and_no_job_has_failed(tmp_path):
    assert ended([job(tmp_path)]) == [(0, None)]
    path = tmp_path / "rows.jsonl"
    before = path.read_bytes()
    with full_disk(len(before) + 10), pytest.raises(CannotWrite, match="cannot write rows to"):
        ended([job(tmp_path, seed=1), job(tmp_path, seed=2)])
    assert path.read_bytes() == before


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_full_disk_that_a_library_finds_is_no_failure_of_the_job(tmp_path, monkeypatch, number):
    def run(self, record):
        raise OSError(number, "No room", "/elsewhere/cache")

    monkeypatch.setattr(OpenLoop, "run", run)
    with pytest.raises(CannotWrite, match=r"cannot write: .*No room: '/elsewhere/cache'"):
        ended([job(tmp_path), job(tmp_path, "ekf")])
    assert not (tmp_path / "rows.jsonl").exists()


def test_other_errors_of_the_system_are_failures_of_the_job(tmp_path, monkeypatch):
    def run(self, record):
        raise FileNotFoundError(errno.ENOENT, "No such file", "mine.csv")

    monkeypatch.setattr(EKF, "run", run)
    ((_, error),) = ended([job(tmp_path, "ekf")])
    assert "mine.csv" in str(error)
    (failure,) = rows.load(tmp_path / "rows.jsonl").failures
    assert failure["error"] == error


class Result:
    """A trained object as small as can be."""

    def save(self, path):
        trained_file.write(path, {"a": 1})


def test_a_training_that_cannot_be_kept_is_no_failure_of_the_job(tmp_path, monkeypatch):
    (tmp_path / "trained").write_text("in the way")
    monkeypatch.setattr(job_module, "train_by_name", lambda *args, **options: Result())
    with pytest.raises(CannotWrite, match=r"cannot write .*trained/.*\.pt: "):
        ended([job(tmp_path, "kkl_supervised")])
    assert not (tmp_path / "rows.jsonl").exists()
