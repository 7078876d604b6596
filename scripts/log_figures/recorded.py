"""Plants with a real sensor log: attitude, a car, and a pendulum of unknown frequency.

The logs are not part of the package. Their figures are left out where the folder is not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from array_api_compat import array_namespace
from benchmarks import Figure, at_most

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.augmented import Unknown, augmented
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Array, Setup, System, independent, stack

LOGS = Path(__file__).parents[3] / "shared" / "data"
"""Folder of the logs, beside that of the project."""
GRAVITY = (0.0, 0.0, 9.81)
"""What an accelerometer at rest measures, in earth axes (east, north, up), in m/s²."""
FIELD = (0.112, 15.64, -40.94)
"""The earth's magnetic field at the place of the log, in µT."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure what estimators reach on the logs."""
    if LOGS.exists():
        yield from attitude()
        yield from car()
        yield from pendulum()


@lru_cache(maxsize=8)
def columns(name: str) -> dict[str, np.ndarray]:
    """Return the columns of a log by name; an empty cell is NaN."""
    table = np.genfromtxt(LOGS / name, delimiter=",", names=True)
    return {column: table[column] for column in table.dtype.names or ()}


@dataclass(frozen=True)
class Attitude(System):
    """The orientation of a body that turns slowly, as a quaternion from its axes to those of the
    earth, and the bias of its gyroscope. Accelerometer and magnetometer see gravity and the earth's
    field in the axes of the body.

    The noise of both sensors is that of the lengths of their vectors, which are known whatever the
    orientation: 0.53 m/s² and 0.75 µT in the log. Their errors last from sample to sample.
    White noise with the same effect is larger by √(1 + 2Σρ), where ρ are their autocorrelations up
    to the first below zero: 1.9 and 3.7 times, which is 1.0 m/s² and 2.8 µT. The likelihood of the
    innovations would choose 0.4 m/s² and 0.9 µT, since it takes these errors for white. The process
    noise stands for that of the gyroscope, half of 0.1 °/s per √Hz.
    """

    state_names = ("qw", "qx", "qy", "qz", "bx", "by", "bz")
    output_names = ("ax", "ay", "az", "mx", "my", "mz")
    input_names = ("gx", "gy", "gz")
    input_hold = "linear"
    scale = (1.0, 1.0, 1.0, 1.0, 0.05, 0.05, 0.05)
    setups: ClassVar = {
        "benchmark": Setup(
            x0_low=(1.0, 0, 0, 0, 0, 0, 0),
            x0_high=(1.0, 0, 0, 0, 0, 0, 0),
            xhat0=(1.0, 0, 0, 0, 0, 0, 0),
            P0=independent(0.5, 0.5, 0.5, 0.5, 0.02, 0.02, 0.02),
            duration=40.0,
            dt=0.0175,
            noise_std=(1.0, 1.0, 1.0, 2.8, 2.8, 2.8),
            process_noise=(0.001, 0.001, 0.001, 0.001, 1e-4, 1e-4, 1e-4),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        w, i, j, k = (x[..., n] for n in range(4))
        p, q, r = (0.5 * (u[..., n] - x[..., 4 + n]) for n in range(3))
        return stack(
            x,
            -i * p - j * q - k * r,
            w * p + j * r - k * q,
            w * q - i * r + k * p,
            w * r + i * q - j * p,
            0.0,
            0.0,
            0.0,
        )

    def h(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        quaternion = x[..., :4]
        length = xp.sqrt(xp.sum(quaternion * quaternion, axis=-1))
        w, i, j, k = (x[..., n] / length for n in range(4))
        # Rows of the rotation from the earth's axes to those of the body.
        rows = (
            (1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)),
            (2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)),
            (2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)),
        )
        seen = [
            sum((a * b for a, b in zip(row, vector, strict=True)), 0.0)
            for vector in (GRAVITY, FIELD)
            for row in rows
        ]
        return stack(x, *seen)


def rotation(angle: float, axis: tuple[float, float, float]) -> np.ndarray:
    """Return the quaternion of a rotation by an angle (rad) about an axis of length one."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of two quaternions (..., 4)."""
    (w, i, j, k), (p, q, r, s) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    parts = (
        w * p - i * q - j * r - k * s,
        w * q + i * p + j * s - k * r,
        w * r - i * s + j * p + k * q,
        w * s + i * r - j * q + k * p,
    )
    return np.stack(parts, axis=-1)


def attitude_error(name: str, off: float) -> np.ndarray:
    """Return the total angle (rad) between the estimated and the reference orientation at each
    sample, from a start that is off by an angle (rad)."""
    log, reference = columns("attitude/imu.csv"), columns("attitude/reference.csv")
    y = np.stack([log[n] for n in Attitude.output_names], axis=-1)
    u = np.stack([log[n] for n in Attitude.input_names], axis=-1)
    true = np.stack([reference[n] for n in ("qw", "qx", "qy", "qz")], axis=-1)
    first = times(true[np.isfinite(true[:, 0])][0], rotation(off, (0.6, 0.0, 0.8)))
    std = max(0.05, off / 2)  # a quaternion moves by half the angle
    mean, cov = np.append(first, np.zeros(3)), np.diag([std**2] * 4 + [0.02**2] * 3)
    record = Record(log["t"], y[None], u[None], Prior(mean[None], cov[None]))
    system = Attitude(measured_input=True)
    setup = Attitude.setups["benchmark"]
    found = ESTIMATORS.resolve(name).for_setup(system, setup).run(record).xhat[0, :, :4]
    found = found / np.linalg.norm(found, axis=-1, keepdims=True)
    return 2 * np.arccos(np.clip(abs((found * true).sum(axis=-1)), 0.0, 1.0))


def attitude() -> Iterator[Figure]:
    """The error of the orientation: its root mean square over the log."""
    for name, asked in (("ekf", 2.0), ("ukf", 2.0), ("rts_smoother", 1.85)):
        error = np.degrees(attitude_error(name, np.radians(6)))
        rms = float(np.sqrt(np.nanmean(error**2)))
        yield at_most(f"attitude, {name}: total angle", rms, "°", asked)
    for name in ("ekf", "ukf"):
        error = np.degrees(attitude_error(name, np.radians(160)))
        rms = float(np.sqrt(np.nanmean(error[len(error) // 2 :] ** 2)))
        yield at_most(f"attitude, {name}: total angle, second half, from 160° off", rms, "°", 3.0)


@dataclass(frozen=True)
class Car(System):
    """A car in the plane; gyroscope and accelerometer, each with a bias, are its inputs.

    The levels of noise were chosen by the likelihood of an EKF's innovations over the log, among
    1,200 draws, and rounded. The error of a satellite receiver drifts, and the
    position here includes that drift, 0.8 m in a second: its log likelihood is -360, and -765 with
    white noise of 2 m in its place. The likelihood goes on rising with less white noise (-301 at
    0.1 m), so that 0.5 m is no maximum but a floor. The held-out fixes are of the same receiver and
    share its drift: the errors say how near its fixes are, not how near the road is.
    """

    state_names = ("px", "py", "heading", "speed", "bias_gyro", "bias_acc")
    state_period = (None, None, 2 * np.pi, None, None, None)
    output_names = ("px", "py", "speed")
    input_names = ("gyro", "acc")
    input_hold = "linear"
    scale = (100.0, 100.0, 1.0, 10.0, 0.05, 0.5)
    setups: ClassVar = {
        "benchmark": Setup(
            x0_low=(0.0,) * 6,
            x0_high=(0.0,) * 6,
            xhat0=(0.0,) * 6,
            P0=independent(5.0, 5.0, 3.0, 2.0, 0.05, 0.5),
            duration=216.0,
            dt=0.02,
            noise_std=(0.5, 0.5, 0.2),
            process_noise=(0.8, 0.8, 0.01, 1.0, 1e-3, 0.01),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        heading, speed = x[..., 2], x[..., 3]
        turn, push = u[..., 0] - x[..., 4], u[..., 1] - x[..., 5]
        return stack(x, speed * xp.cos(heading), speed * xp.sin(heading), turn, push, 0.0, 0.0)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return stack(x, x[..., 0], x[..., 1], x[..., 3])


def car_run(name: str, until: float = np.inf) -> tuple[np.ndarray, Estimates]:
    """Return the sample times of the log up to a time (s), and the estimates of an estimator."""
    log = columns("car/log.csv")
    log = {column: values[log["t"] <= until] for column, values in log.items()}
    y = np.stack([log[n] for n in Car.output_names], axis=-1)
    u = np.stack([log[n] for n in Car.input_names], axis=-1)
    setup = Car.setups["benchmark"]
    # A driver knows the first course: here that of the first two fixes far enough apart.
    fixes = np.flatnonzero(np.isfinite(y[:, 0]))
    away = fixes[np.flatnonzero(np.hypot(*(y[fixes, :2] - y[fixes[0], :2]).T) > 10.0)[0]]
    course = np.arctan2(*(y[away, :2] - y[fixes[0], :2])[::-1])
    mean = np.array([*y[fixes[0], :2], course, y[fixes[0], 2], 0.0, 0.0])
    cov = np.diag(np.square([5.0, 5.0, 0.5, 1.0, 0.1, 0.5]))
    record = Record(log["t"], y[None], u[None], Prior(mean[None], cov[None]))
    made = ESTIMATORS.resolve(name).for_setup(Car(measured_input=True), setup)
    return log["t"], made.run(record)


def off_fixes(t: np.ndarray, found: Estimates) -> np.ndarray:
    """Return the errors (m) of estimates at times t (s), at the fixes that were held out."""
    fixes = columns("car/held_out_fixes.csv")
    within = fixes["t"] <= t[-1]
    at = [np.interp(fixes["t"][within], t, found.xhat[0, :, i]) for i in range(2)]
    return np.hypot(at[0] - fixes["px"][within], at[1] - fixes["py"][within])


def car() -> Iterator[Figure]:
    """The error of the position at the fixes that were held out: its root mean square."""
    for name, asked in (("ekf", 3.4), ("rts_smoother", 2.1), ("enkf", None)):
        t, found = car_run(name)
        rms = float(np.sqrt(np.mean(off_fixes(t, found) ** 2)))
        what = f"car, {name}: position at held-out fixes"
        yield Figure(what, rms, "m", "", None) if asked is None else at_most(what, rms, "m", asked)
        if name == "enkf":
            # A gyroscope's bias is below 0.5 rad/s, and slopes below 30 % are 3 m/s².
            for i, what, unit, most in (
                (4, "gyroscope", "rad/s", 0.5),
                (5, "accelerometer", "m/s²", 3.0),
            ):
                bias = float(abs(found.xhat[0, :, i]).max())
                yield at_most(f"car, enkf: largest bias of the {what}", bias, unit, most)


@dataclass(frozen=True)
class Pendulum(System):
    """A pendulum that swings freely; its angle from hanging at rest is measured."""

    w2: float = 64.22
    """Square of the frequency of small swings, g/l (1/s²)."""
    damping: float = 0.0672
    """Damping (1/s)."""

    state_names = ("theta", "omega")
    output_names = ("theta",)
    scale = (1.0, 8.0)
    setups: ClassVar = {
        "benchmark": Setup((-1.6, -6.0), (1.6, 6.0), duration=9.0, dt=0.01, noise_std=0.003)
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        xp = array_namespace(x)
        theta, omega = x[..., 0], x[..., 1]
        return stack(x, omega, -self.w2 * xp.sin(theta) - self.damping * omega)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]


def pendulum() -> Iterator[Figure]:
    """The frequency found and the error of the velocity, with frequency and damping unknown."""
    unknown = {"w2": Unknown(60.0, 10.0), "damping": Unknown(0.1, 0.05)}
    system = augmented(Pendulum(), parameters=unknown)
    setup = system.setups["benchmark"]
    for swing in ("swing-1", "swing-2"):
        log, reference = (columns(f"pendulum/{swing}{part}.csv") for part in ("", "-velocity"))
        prior = Prior.of(system, setup, 1)
        record = Record(log["t"], log["y1"][None, :, None], np.zeros((1, len(log["t"]), 0)), prior)
        for name in ("ekf", "ukf"):
            found = ESTIMATORS.resolve(name).for_setup(system, setup).run(record)
            off = abs(float(found.xhat[0, -1, 2]) / 64.22 - 1)
            yield at_most(f"pendulum, {swing}, {name}: error of ω²", 100 * off, "%", 0.5)
            omega = np.interp(reference["t"], log["t"], found.xhat[0, :, 1])
            error = (omega - reference["omega"])[reference["t"] >= 1]
            share = float(np.sqrt(np.mean(error**2)) / abs(reference["omega"]).max())
            what = f"pendulum, {swing}, {name}: velocity, of its maximum"
            yield at_most(what, 100 * share, "%", 1.0)
