import re
import subprocess
import sys

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.cli import main
from pinnobs_gym.cli.video import Pace, write_video
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring import rows

CLOCK = """
from pinnobs_gym import Estimator, State

class Clock(Estimator):
    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        return State(0 * state.xhat + t / 5, t=t)
"""


def read(path, size):
    """The frames per second of a video, and its frames (number, height, width, 3)."""
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    run = subprocess.run(command, capture_output=True, check=True)
    fps = re.search(rb"([\d.]+) fps", run.stderr)
    found = re.search(rb" (\d+)x(\d+)[ ,]", run.stderr)
    assert (int(found[2]), int(found[1])) == size
    return float(fps[1]), np.frombuffer(run.stdout, np.uint8).reshape(-1, *size, 3)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def evaluate(*arguments):
    where = ["evaluate", "--system", "Academic", "--episodes", "2", "--out", "ev"]
    return main([*where, *map(str, arguments)])


def test_the_video_shows_the_estimates_of_the_first_episode(folder, capsys):
    (folder / "clock_module.py").write_text(CLOCK)
    chosen = ["--estimator", "clock_module:Clock", "--condition", "noise5+dt0.5", "--seed", 3]
    assert evaluate(*chosen, "--video", "new/out.mp4") == 0
    *_, video, following = capsys.readouterr().out.splitlines()
    assert video == "video: new/out.mp4"
    assert following.startswith("next: pinnobs ")
    assert [path.name for path in (folder / "new").iterdir()] == ["out.mp4"]
    assert len(rows.read(folder / "ev" / "rows.jsonl")) == 2

    env = gym.make("pinnobs/Academic-v0", render_mode="rgb_array", condition="noise5+dt0.5")
    env.reset(seed=3)
    expected = [env.render()]
    for k in range(1000):
        env.step(np.full(2, 0.01 * k / 5))
        expected += [env.render()] if k % 100 == 99 else []
    fps, frames = read(folder / "new" / "out.mp4", expected[0].shape[:2])
    assert fps == 25  # every fourth sample of 0.01 s, in real time
    assert abs(len(frames) - (251 + 25)) <= 1  # from 0 to 10 s, and the end held for a second
    shown = frames[:251:25].astype(int)
    errors = abs(shown[:, None] - np.array(expected)).mean(axis=(2, 3, 4))
    assert (errors.argmin(axis=1) == np.arange(11)).all()
    assert errors.diagonal().max() < 1  # of 255, lost by the compression
    assert (abs(frames[251:] - frames[250].astype(int)).mean(axis=(1, 2, 3)) < 1).all()


@pytest.mark.parametrize(
    ("duration", "dt", "stride", "fps"),
    [
        (20.0, 0.02, 2, 25.0),  # real time, as all from 5 to 20 s
        (5.0, 1 / 30, 1, 30.0),
        (10.0, 0.1, 1, 10.0),
        (1.0, 0.001, 7, 1 / 5 / 0.007),  # a fifth as fast
        (60.0, 0.01, 10, 30.0),  # three times as fast
        (0.1, 0.1, 1, 0.2),
    ],
)
def test_the_pace(duration, dt, stride, fps):
    pace = Pace.of(duration, dt)
    assert (pace.stride, pace.fps) == (stride, pytest.approx(fps))
    assert pace.fps <= 30 + 1e-6


def test_an_estimate_that_is_not_finite_ends_the_video(tmp_path):
    class Lost(EKF):
        def run(self, record):
            estimates = super().run(record)
            estimates.xhat[:, 4:] = np.nan
            return estimates

    setup = Linear.setups["benchmark"]
    estimator = Lost.for_setup(Linear(), setup)
    path = tmp_path / "lost.mp4"
    path.write_text("of an earlier run")
    pace = write_video(path, estimator, Game.of(Linear), 0)
    _, frames = read(path, (336, 640))
    assert abs(len(frames) - (6 + round(pace.fps))) <= 1
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("out.avi", "video out.avi; expected a name that ends in .mp4"),
        ("out", "video out; expected a name that ends in .mp4"),
        ("file/out.mp4", "cannot write to folder file: "),
        ("folder.mp4", "cannot write folder.mp4: it is a folder"),
    ],
)
def test_mistakes_are_one_line_before_anything_is_run(folder, capsys, path, message):
    (folder / "file").write_text("")
    (folder / "folder.mp4").mkdir()
    assert evaluate("--video", path) == 2
    told = capsys.readouterr().err
    assert message in told
    assert len(told.splitlines()) == 1
    assert not (folder / "ev").exists()


def test_without_moviepy_it_says_what_to_install(folder, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "gymnasium.utils.save_video", raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == "moviepy"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "moviepy", None)
    assert evaluate("--video", "out.mp4") == 2
    assert 'pip install "pinnobs-gym[video]"' in capsys.readouterr().err
    assert not (folder / "ev").exists()


def test_a_full_disk_is_one_line_and_leaves_what_was_there(folder, capsys, monkeypatch):
    def full(frames, place, **options):
        raise OSError("[Errno 28] No space left on device\n\nMoviePy error: FFMPEG ...")

    monkeypatch.setattr("gymnasium.utils.save_video.save_video", full)
    (folder / "out.mp4").write_text("of an earlier run")
    assert evaluate("--video", "out.mp4", "--condition", "dt5") == 2
    told = capsys.readouterr().err
    assert "cannot write out.mp4: [Errno 28] No space left" in told
    assert len(told.splitlines()) == 1
    assert (folder / "out.mp4").read_text() == "of an earlier run"
    assert len(rows.read(folder / "ev" / "rows.jsonl")) == 2  # the scores are kept
