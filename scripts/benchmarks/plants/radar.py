"""A vehicle that a radar sees by its range and bearing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from array_api_compat import array_namespace

from benchmarks import Figure, at_most
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.system import Array, Setup, System, independent, matrix, stack

RUNS = 20
"""Number of tracks of the radar."""
LOST = 10.0
"""Error of the position, in m, above which a track is lost."""


@dataclass(frozen=True)
class Radar(System):
    """A vehicle that turns at a nearly constant rate, seen by a radar at the origin that measures
    its range and bearing. Many of its tracks cross the negative x axis, where the bearing jumps
    from π to −π."""

    state_names = ("px", "py", "speed", "heading", "turn_rate")
    output_names = ("range", "bearing")
    output_period = (None, 2 * np.pi)
    state_period = (None, None, None, 2 * np.pi, None)
    units: ClassVar = {
        "px": "m",
        "py": "m",
        "speed": "m/s",
        "heading": "rad",
        "turn_rate": "rad/s",
        "range": "m",
        "bearing": "rad",
    }
    scale = (50.0, 50.0, 10.0, 3.0, 0.2)
    setups: ClassVar = {
        "benchmark": Setup(
            x0_low=(-60.0, 7.0, 9.0, -0.3, -0.25),
            x0_high=(-50.0, 13.0, 11.0, 0.3, 0.25),
            duration=60.0,
            dt=0.5,
            noise_std=(1.0, 0.02),
            process_noise=tuple(np.array([0.05, 0.05, 0.1, 0.005, 0.004]) / np.sqrt(0.5)),
            xhat0=(-55.0, 10.0, 10.0, 0.0, 0.0),
            P0=independent(10.0, 10.0, 3.0, 0.5, 0.3),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        speed, heading = x[..., 2], x[..., 3]
        return stack(x, speed * xp.cos(heading), speed * xp.sin(heading), 0.0, x[..., 4], 0.0)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        px, py = x[..., 0], x[..., 1]
        return stack(x, xp.sqrt(px * px + py * py), xp.atan2(py, px))

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        speed, cos, sin = x[..., 2], xp.cos(x[..., 3]), xp.sin(x[..., 3])
        rows = [[0, 0, cos, -speed * sin, 0], [0, 0, sin, speed * cos, 0], [0] * 5]
        return matrix(x, [*rows, [0, 0, 0, 0, 1], [0] * 5])

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        px, py = x[..., 0], x[..., 1]
        square = px * px + py * py
        length = xp.sqrt(square)
        return matrix(
            x, [[px / length, py / length, 0, 0, 0], [-py / square, px / square, 0, 0, 0]]
        )

    def admissible(self, x0: Array) -> Array:
        """The vehicle turns by at least 0.1 rad/s, to either side."""
        return array_namespace(x0).abs(x0[..., 4]) >= 0.1


def tracks(estimator: str, runs: int = RUNS) -> np.ndarray:
    """Return the errors of the position in m, (runs, samples), in the second half of tracks of
    fixed seeds."""
    source = EpisodeSource(Radar)
    episodes = source.play(source.draw(source.streams(range(runs))))
    record = source.record(episodes)
    made = ESTIMATORS.resolve(estimator).for_setup(source.system, source.setup)
    xhat, x = made.run(record).xhat, episodes.x[: record.num_samples].swapaxes(0, 1)
    error = np.linalg.norm((xhat - x)[..., :2], axis=-1)
    return error[:, record.num_samples // 2 :]


def figures(repeats: int) -> Iterator[Figure]:
    """Tracks lost, and the error of the position: the root mean square over the second half of a
    track, its median over the tracks."""
    for name in ("ekf", "ukf", "enkf", "mhe"):
        error = tracks(name)
        lost = int((~(error <= LOST)).any(axis=1).sum())
        yield at_most(f"radar, {name}: tracks lost of {RUNS}", lost, "", 0)
        rms = float(np.median(np.sqrt((error**2).mean(axis=1))))
        yield at_most(f"radar, {name}: error of the position", rms, "m", 1.1)
    lost = int((~(tracks("particle") <= LOST)).any(axis=1).sum())
    yield at_most(f"radar, particle: tracks lost of {RUNS}", lost, "", 0)
