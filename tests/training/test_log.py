import re
import sys

import pytest
from damage import full_disk
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pinnobs_gym.training.log import SILENT, Log


def events(folder):
    accumulator = EventAccumulator(str(folder), size_guidance={"scalars": 0, "tensors": 0})
    accumulator.Reload()
    return accumulator


def test_scalars_and_figures_can_be_read_back(tmp_path):
    figure = Figure()
    figure.subplots().plot([0, 1], [1, 0])
    with Log(tmp_path / "run") as log:
        for step in range(5):
            log.scalar("loss", 0.5**step, step)
        log.figure("states", figure, 7)
    read = events(tmp_path / "run")
    assert [(e.step, e.value) for e in read.Scalars("loss")] == [(k, 0.5**k) for k in range(5)]
    (image,) = read.Images("states")
    assert image.step == 7
    assert image.encoded_image_string.startswith(b"\x89PNG")


def test_hparams_stay_in_the_run_and_take_any_value(tmp_path):
    with Log(tmp_path) as log:
        log.scalar("loss", 1.0, 0)
        params = {"width": 20, "rate": 1e-3, "fast": True, "budget": None, "poles": (1, 2)}
        log.hparams(params, {"end/loss": 0.25})
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []
    read = events(tmp_path)
    assert read.Scalars("end/loss")[0].value == 0.25
    plugins = read.summary_metadata["_hparams_/session_start_info"].plugin_data
    assert plugins.plugin_name == "hparams"
    for name in (b"width", b"rate", b"fast", b"budget", b"(1, 2)"):
        assert name in plugins.content


def test_a_closed_log_goes_on_when_written_again(tmp_path):
    log = Log(tmp_path)
    log.scalar("a", 1.0, 0)
    log.close()
    log.scalar("a", 2.0, 1)
    log.close()
    log.close()
    # Of two files of one second TensorBoard may read either first.
    assert {e.step: e.value for e in events(tmp_path).Scalars("a")} == {0: 1.0, 1: 2.0}


def test_without_a_folder_nothing_happens(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(
        sys.modules, "tensorboard.summary.writer.record_writer", None
    )  # importing it would raise
    with Log(None) as log:
        log.scalar("a", 1.0, 0)
        log.figure("b", Figure(), 0)
        log.hparams({"e": 1}, {"f": 2.0})
    assert not log.active
    assert not SILENT.active
    assert list(tmp_path.iterdir()) == []


def test_tensorboard_is_imported_on_the_first_write(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "tensorboard.summary.writer.record_writer", None)
    log = Log(tmp_path)
    with pytest.raises(ImportError):
        log.scalar("a", 1.0, 0)


def test_without_a_place_to_write_to_one_line_is_logged_and_the_run_goes_on(tmp_path, caplog):
    (tmp_path / "file").write_text("in the way")
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with Log(folder) as log:
            log.scalar("a", 1.0, 0)
            log.hparams({"e": 1}, {"f": 2.0})
            assert not log.active
    (line,) = caplog.messages
    assert line.startswith(f"cannot write to folder {tmp_path / 'file'}: ")
    assert "\n" not in line
    assert (tmp_path / "file").read_text() == "in the way"


def test_a_full_disk_ends_the_log_and_nothing_else(tmp_path, caplog):
    log = Log(tmp_path)
    log.scalar("a", 1.0, 0)
    log.close()
    with full_disk(3000), log:
        for step in range(1, 1000):
            log.scalar("a", 1.0, step)
    assert not log.active
    (line,) = caplog.messages
    assert re.match(r"cannot write .*: File too large; what follows is done without", line)
    read = {e.step for e in events(tmp_path).Scalars("a")}
    assert {0, 1} < read  # what was written before is read
    assert len(read) < 100
