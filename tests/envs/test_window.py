"""render_mode="human", in a process of its own: a window belongs to its main thread."""

import os
import subprocess
import sys

import pytest
from waiting import PATIENCE

pytest.importorskip("PySide6.QtWidgets", exc_type=ImportError)

EPISODE = """
from PySide6.QtWidgets import QApplication

application = QApplication([])  # without a display Matplotlib takes Qt only from who has it

import sys

import gymnasium as gym
import numpy as np
from matplotlib import pyplot

import pinnobs_gym

system, raised = sys.argv[1], []


def play(mode):
    env = gym.make(f"pinnobs/{system}-v0", render_mode=mode, duration=8 * step)
    _, info = env.reset(seed=3)
    yield env
    truncated = False
    while not truncated:
        action = info["state"].astype(np.float32) * 1.1
        _, _, _, truncated, info = env.step(action)
        yield env


step = pinnobs_gym.systems.SYSTEMS.resolve(system).setups["benchmark"].dt
frames = [env.render() for env in play("rgb_array")]
windows = []
for env, frame in zip(play("human"), frames, strict=True):
    (number,) = pyplot.get_fignums()  # one window for the whole episode
    canvas = pyplot.figure(number).canvas
    window = canvas.manager.window
    if not windows:
        window.raise_ = lambda: raised.append(window)
    windows.append(window)
    assert window.isVisible()
    image = canvas.grab().toImage()
    assert (image.height(), image.width()) == frame.shape[:2], image.size()
    shown = np.array(image.constBits()).reshape(*frame.shape[:2], 4)
    assert np.array_equal(shown[..., 2::-1], frame)  # Qt has blue first
assert all(window is windows[0] for window in windows)
assert not raised  # a window that comes to the front at each frame takes the focus
assert len(frames) == 9 and (frames[-1] != frames[0]).any()
env.close()
application.processEvents()
assert not pyplot.get_fignums()
assert not windows[0].isVisible()
env.close()  # once more does no harm
print("shown", len(frames))
"""


def test_an_episode_is_shown_in_a_window_that_close_closes():
    environment = os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    run = subprocess.run(
        [sys.executable, "-c", EPISODE, "InductionMotor"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == ["shown", "9"]
    assert "Traceback" not in run.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="others always have a display")
def test_without_a_display_one_sentence_says_what_is_missing():
    play = "import gymnasium, pinnobs_gym\n"
    play += "gymnasium.make('pinnobs/Academic-v0', render_mode='human').reset(seed=0)"
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    run = subprocess.run(
        [sys.executable, "-c", play],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert run.returncode == 1
    message = "needs a display and a window toolkit for matplotlib, such as PySide6"
    assert message in run.stderr.splitlines()[-1]
