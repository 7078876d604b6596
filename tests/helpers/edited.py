"""A plant and an estimator in files of their own, and edits of them."""

import itertools
import os

OBSERVER = '''
from dataclasses import dataclass

from pinnobs_gym import Estimator, State
from pinnobs_gym.simulation.model import model_step

from gains import GAIN


@dataclass(frozen=True)
class Obs(Estimator):
    """An observer."""

    name = "obs"

    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        dt = 0.0 if state.t is None else t - state.t
        x = model_step(self.system, t - dt, t, state.xhat, state.u, u) if dt else state.xhat
        return State(x + dt * GAIN * (y - self.system.h(t, x, u)), t=t, u=u)
'''
PLANT = """
from dataclasses import dataclass

from pinnobs_gym import Setup, System, stack

RATE = 0.3


@dataclass(frozen=True)
class Oscillator(System):
    state_names = ("p", "v")
    output_names = ("y1",)
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((-1.0, -1.0), (1.0, 1.0), duration=2.0, dt=0.1, noise_std=0.05)}

    def f(self, t, x, u):
        return stack(x, x[..., 1], -x[..., 0] - RATE * x[..., 1])

    def h(self, t, x, u):
        return x[..., :1]
"""
FILES = {"mine.py": OBSERVER, "gains.py": "GAIN = 3.0\n", "plant.py": PLANT}
EDITS = {
    "a comment": ("gains.py", "GAIN = 3.0", "GAIN = 3.0  # in 1/s"),
    "a docstring": ("mine.py", "An observer.", "My observer."),
    "a helper module": ("gains.py", "3.0", "-50.0"),
    "the estimator": ("mine.py", "x + dt * GAIN", "x + 2 * dt * GAIN"),
    "f": ("plant.py", "RATE = 0.3", "RATE = 0.4"),
    "h": ("plant.py", "return x[..., :1]", "return 2 * x[..., :1]"),
    "the scale": ("plant.py", "scale = (1.0, 1.0)", "scale = (1.0, 2.0)"),
    "the setup": ("plant.py", "noise_std=0.05", "noise_std=0.06"),
}
"""What is edited: the file, what stood there and what stands there then."""


_times = itertools.count(1_000_000_000, 10)


def write(folder, edit=None):
    """Write the files, edited or not, each time as if some seconds after the last."""
    time = next(_times)
    file, old, new = EDITS[edit] if edit else ("mine.py", "", "")
    for name, text in FILES.items():
        assert name != file or old in text
        (folder / name).write_text(text.replace(old, new) if name == file and old else text)
        os.utime(folder / name, (time, time))
